"""One page per drive: what the recording holds and what is wrong with it."""

from streetscan.drive_sheets import write_drive_sheet
from streetscan.drives import read_drive_facts
from streetscan.inspection import inspect_drive
from streetscan.logs import logged


def main(facts: str, schema: str, mcap: str, frames: str, truth: str, sheet: str, drive: str, n_pictured: int) -> None:
    """Write the page of an imported drive.

    Args:
        facts, schema: config/drives/<drive>.yaml and config/drive.schema.yaml.
        mcap, frames, truth: outputs of import_drive.
        sheet: output, one HTML file.
        drive: its name.
        n_pictured: frames and images shown.
    """
    known = read_drive_facts(facts, schema)
    write_drive_sheet(sheet, drive, known.description, known.source, inspect_drive(mcap, frames, truth, n_pictured))


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        main(
            facts=snakemake.input.facts,
            schema=snakemake.input.schema,
            mcap=snakemake.input.mcap,
            frames=snakemake.input.frames,
            truth=snakemake.input.truth,
            sheet=snakemake.output.sheet,
            **snakemake.params,
        )
