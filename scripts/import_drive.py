"""Bring one recording, in whatever format it has, into the form every other step reads."""

from streetscan.drives import Recording, import_drive, read_drive_facts
from streetscan.logs import logged


def main(facts: str, schema: str, data_root: str, drive: str, mcap: str, frames: str, truth: str) -> None:
    """Import a drive.

    Args:
        facts, schema: config/drives/<drive>.yaml and config/drive.schema.yaml.
        data_root: folder the drive's root is relative to.
        drive: its name.
        mcap, frames, truth: outputs drive.mcap, frames.csv and the folder truth/.
    """
    import_drive(Recording(read_drive_facts(facts, schema), data_root), drive, mcap, frames, truth)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            facts=snakemake.input.facts,
            schema=snakemake.input.schema,
            mcap=snakemake.output.mcap,
            frames=snakemake.output.frames,
            truth=snakemake.output.truth,
            **snakemake.params,
        )
