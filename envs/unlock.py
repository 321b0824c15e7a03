"""Remove the lock a killed Snakemake left in this directory, unless one is still running here."""

import os
import subprocess
import sys
from pathlib import Path

import psutil

HOME = Path(__file__).resolve().parent.parent


def is_held(directory: Path) -> bool:
    """Whether another process whose command names snakemake works in `directory`."""
    for process in psutil.process_iter(["pid", "cwd", "cmdline"]):
        info = process.info
        if info["pid"] != os.getpid() and info["cwd"] == str(directory) and any("snakemake" in part for part in info["cmdline"] or []):
            return True
    return False


def main() -> None:
    """Unlock the current directory when its lock is nobody's."""
    here = Path.cwd()
    locks = here / ".snakemake" / "locks"
    if locks.is_dir() and any(locks.iterdir()) and not is_held(here):
        command = [sys.executable, "-m", "snakemake", "--snakefile", str(HOME / "Snakefile"), "--unlock"]
        subprocess.run([*command, "--configfile", str(HOME / "config" / "test.yaml")], check=True)


if __name__ == "__main__":
    main()
