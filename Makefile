# Two commands do everything from a bare checkout: `make run` and `make test`. `make help` lists the rest.
SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help

PYTHON ?= python3
CONFIG ?= config/default.yaml
TARGET ?=
BIN := .venv/bin
# One BLAS/OpenMP thread per process unless a rule asks for more: jobs already fill the cores.
export OMP_NUM_THREADS ?= 1
export PYTHONHASHSEED ?= 0

.PHONY: help install run test lint format bench dag clean results

help:  ## Show this list.
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

install: .venv/.installed  ## Create .venv and install the pinned packages (done by every other target when needed).

.venv/.installed: envs/requirements.txt envs/apt.txt pyproject.toml
	@bash envs/install_apt.sh
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -r envs/requirements.txt
	$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --editable .
	touch $@

run: install  ## Run the workflow (CONFIG=config/test.yaml chooses a run, TARGET=... a part of it).
	@test -f $(CONFIG) || { echo "CONFIG=$(CONFIG): no such file; name one in config/, or write it."; exit 2; }
	@$(BIN)/python envs/unlock.py
	PATH="$$PWD/$(BIN):$$PATH" $(BIN)/snakemake --configfile $(CONFIG) $(if $(TARGET),-- $(TARGET))

test: install  ## Run the test suite, a file at a time on each core.
	$(BIN)/python -m pytest -n auto --maxprocesses 4 --dist loadfile

lint: install  ## Check style, formatting and the workflow.
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/snakefmt --check Snakefile rules
	$(BIN)/snakemake --configfile config/test.yaml --lint

format: install  ## Format Python and Snakemake files.
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/snakefmt Snakefile rules

bench: install  ## Measure speed and memory; writes results/bench.csv.
	$(BIN)/python -m benchmarks

dag: install  ## Write the step diagram into README.md.
	$(BIN)/python docs/update_diagram.py

results: install  ## Keep what the paper run and `make bench` measured in docs/results/.
	$(BIN)/python docs/keep_results.py

clean:  ## Delete results/ and caches; .venv stays.
	rm -rf results .snakemake .pytest_cache .ruff_cache .hypothesis build *.egg-info
	find . -name __pycache__ -not -path './.venv/*' -prune -exec rm -rf {} +
