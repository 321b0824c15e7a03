"""envs/unlock.py: a lock is removed only when no Snakemake works in the directory."""

import importlib.util
import subprocess
import sys
import time

from dag import HOME, snakemake


def load_unlock():
    spec = importlib.util.spec_from_file_location("unlock", HOME / "envs" / "unlock.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_running_snakemake_holds_its_directory(tmp_path):
    unlock = load_unlock()
    assert not unlock.is_held(tmp_path)
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)", "snakemake"], cwd=tmp_path)
    try:
        time.sleep(0.5)
        assert unlock.is_held(tmp_path)
    finally:
        process.kill()
        process.wait()
    assert not unlock.is_held(tmp_path)


def test_a_lock_left_behind_is_removed(tmp_path, monkeypatch):
    snakemake("--dry-run", "--cores", "1", "--configfile", str(HOME / "config" / "test.yaml"), directory=tmp_path)
    locks = tmp_path / ".snakemake" / "locks"
    locks.mkdir(parents=True, exist_ok=True)
    (locks / "0.output.lock").write_text("results/tabulate_benchmarks/test/report.html\n")
    monkeypatch.chdir(tmp_path)
    load_unlock().main()
    assert not list(locks.glob("*"))
