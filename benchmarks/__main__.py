"""`make bench`: every speed and memory figure, in one table. Ratios are pairs measured in the same run."""

import argparse
import logging

import pandas as pd

from benchmarks.bench_calibration import bench_calibration
from benchmarks.bench_drives import bench_drives
from benchmarks.bench_labelling import run_labelling_benchmark
from benchmarks.bench_localization import bench_localization
from benchmarks.bench_registration import bench_registration
from benchmarks.bench_sensors import bench_sensors
from benchmarks.bench_simulation import bench_simulation
from benchmarks.bench_textures import bench_textures
from streetscan.benchmarks.speed import renew_rows
from streetscan.io.tables import save_tables

COLUMNS = ["benchmark", "metric", "value", "unit", "peer", "n"]
logger = logging.getLogger("streetscan.bench")


def main() -> None:
    """Run the benchmarks named on the command line, or all, and write the rows of each into results/bench.csv once it is done."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data-root", default="../shared/data", help="folder with real recordings")
    parser.add_argument("--output", default="results/bench.csv")
    parser.add_argument("names", nargs="*", help="which; all by default")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s", datefmt="%H:%M:%S")
    benchmarks = {
        "simulation": bench_simulation,
        "sensors": bench_sensors,
        "textures": bench_textures,
        "labelling": lambda: run_labelling_benchmark(arguments.data_root),
        "drives": lambda: bench_drives(arguments.data_root),
        "localization": lambda: bench_localization(arguments.data_root),
        "calibration": bench_calibration,
        "registration": lambda: bench_registration(arguments.data_root),
    }
    chosen = arguments.names or list(benchmarks)
    if unknown := set(chosen) - set(benchmarks):
        parser.error(f"no benchmark named {', '.join(sorted(unknown))}; choose of {', '.join(benchmarks)}")
    for name in chosen:
        logger.info("benchmark %s", name)
        table = pd.DataFrame(benchmarks[name]())[COLUMNS]
        save_tables({arguments.output: renew_rows(arguments.output, table)})
        print(table.to_string(index=False), flush=True)


if __name__ == "__main__":
    main()
