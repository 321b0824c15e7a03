"""The errors a user is meant to read: one sentence that names the place, the finding and the remedy."""


class StreetscanError(Exception):
    """Something the user can mend. The message is one sentence, ready to be shown without a traceback."""


class BadInput(StreetscanError):
    """A file, key, class or value from outside is not what it must be."""

    def __init__(self, where: object, found: str, remedy: str):
        """
        Args:
            where: the file, config key, class or frame at fault.
            found: what was found there.
            remedy: what to do about it.
        """
        self.where, self.found, self.remedy = str(where), found, remedy
        super().__init__(f"{where}: {found}; {remedy}.")

    def __reduce__(self):
        return type(self), (self.where, self.found, self.remedy)
