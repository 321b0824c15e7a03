"""Drive through a simulated street on another day and bring the recording into the form every other step reads."""

import shutil

from streetscan.drives import import_drive, read_drive_facts
from streetscan.logs import logged
from streetscan.simulation.drives import SimulatedRecording


def main(
    facts: str, schema: str, data_root: str, drive: str, street: dict, seed: int, n_threads: int, mcap: str, frames: str, truth: str
) -> None:
    """Simulate a drive; one that was stopped goes on where it was.

    Args:
        facts, schema: config/drives/<drive>.yaml and config/drive.schema.yaml.
        data_root: folder a unit's calibration is relative to.
        drive: its name.
        street: settings of `streetscan.simulation.layout.build_street`, as the map was made with.
        seed: of the city and of everything random.
        n_threads: of the ray caster.
        mcap, frames, truth: outputs drive.mcap, frames.csv and the folder truth/.
    """
    resume_folder = f"{mcap}.resume"
    recording = SimulatedRecording(read_drive_facts(facts, schema), drive, street, seed, data_root, resume_folder, n_threads)
    import_drive(recording, drive, mcap, frames, truth)
    shutil.rmtree(resume_folder)


if __name__ == "__main__":
    with logged(snakemake.log[0]):
        inputs = {"facts": snakemake.input.facts, "schema": snakemake.input.schema}
        main(**inputs, **dict(snakemake.output.items()), **snakemake.params)
