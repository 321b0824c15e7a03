"""One log per job: messages and, when it fails, the whole traceback; the terminal gets one sentence."""

import logging
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from streetscan.errors import StreetscanError


@contextmanager
def logged(path: str | Path) -> Iterator[None]:
    """Send log messages to `path` and the terminal while the block runs.

    An error's traceback goes into the log. A StreetscanError reaches the terminal as its one sentence and ends the
    process with code 1; any other error passes on, since it is ours to mend and its place matters.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    logger = logging.getLogger("streetscan")
    logger.setLevel(logging.INFO)
    handlers = [logging.FileHandler(path, mode="w"), logging.StreamHandler(sys.stderr)]
    for handler in handlers:
        handler.setFormatter(logging.Formatter("%(asctime)s %(message)s", "%H:%M:%S"))
        logger.addHandler(handler)
    try:
        yield
    except BaseException as error:
        handlers[0].stream.write(traceback.format_exc())
        if isinstance(error, StreetscanError):
            print(f"error: {error}", file=sys.stderr, flush=True)
            raise SystemExit(1) from None
        raise
    finally:
        for handler in handlers:
            logger.removeHandler(handler)
            handler.close()
