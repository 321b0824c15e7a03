"""The concrete DAG of a run, read from a dry run."""

import re
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

HOME = Path(__file__).resolve().parents[2]


@dataclass
class Job:
    """One job of a dry run: its rule, input and output files, and wildcards."""

    rule: str
    inputs: list[str] = field(default_factory=list)
    outputs: list[str] = field(default_factory=list)
    wildcards: dict[str, str] = field(default_factory=dict)


def snakemake(*arguments: str, directory: Path = HOME, check: bool = True) -> subprocess.CompletedProcess:
    """Run Snakemake on this workflow in `directory`."""
    command = [sys.executable, "-m", "snakemake", "--snakefile", str(HOME / "Snakefile"), "--directory", str(directory), *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=directory, check=check)


def dry_run(*arguments: str, directory: Path) -> list[Job]:
    """The jobs a run would do from nothing."""
    result = snakemake("--dry-run", "--forceall", "--quiet", "progress", "--cores", "1", *arguments, directory=directory)
    jobs = []
    for line in result.stdout.splitlines() + result.stderr.splitlines():
        if match := re.match(r"(?:local)?rule (\w+):", line):
            jobs.append(Job(match[1]))
        elif match := re.match(r"    (input|output): (.*)", line):
            getattr(jobs[-1], match[1] + "s").extend(re.sub(r" \(.*?\)$", "", part) for part in match[2].split(", "))
        elif match := re.match(r"    wildcards: (.*)", line):
            jobs[-1].wildcards = dict(part.split("=", 1) for part in match[1].split(", "))
    return jobs
