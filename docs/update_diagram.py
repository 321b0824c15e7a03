"""Write the workflow's step diagram into README.md; `--check` only says whether it is up to date."""

import re
import subprocess
import sys
from pathlib import Path

HOME = Path(__file__).resolve().parent.parent
BLOCK = re.compile(r"(<!-- diagram -->\n).*?(<!-- /diagram -->)", re.DOTALL)


def draw_diagram() -> str:
    """The default run's rule graph as a mermaid block; sorted, since Snakemake numbers the rules anew each time."""
    command = [sys.executable, "-m", "snakemake", "--directory", str(HOME), "--snakefile", str(HOME / "Snakefile")]
    # Without real recordings, so that the diagram is the same wherever it is drawn.
    command += ["--forceall", "--rulegraph", "mermaid-js", "--config", "data_root=none"]
    output = subprocess.run(command, check=True, capture_output=True, text=True, cwd=HOME).stdout
    names = dict(re.findall(r"(id\d+)\[(\w+)\]", output))
    edges = sorted(f"{names[a]} --> {names[b]}" for a, b in re.findall(r"(id\d+) --> (id\d+)", output) if names[b] != "all")
    return "\n".join(["```mermaid", "flowchart TB", *(f"    {edge}" for edge in edges), "```", ""])


def main() -> None:
    """Update README.md, or with --check exit with 1 when it is out of date."""
    readme = HOME / "README.md"
    text = readme.read_text()
    updated = BLOCK.sub(lambda match: match[1] + draw_diagram() + match[2], text)
    if "--check" in sys.argv[1:]:
        sys.exit(0 if updated == text else "README.md's step diagram is out of date; run `make dag`.")
    readme.write_text(updated)


if __name__ == "__main__":
    main()
