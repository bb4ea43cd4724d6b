# SpectralZoom: setup, survey, survey-rig, picture, test, lint, docs, notebooks, bench, paper, faults, defects, soak, lock.
#   make survey ARCHIVE=/data/field7    make test PY=python3.12 VENV=/tmp/venv    make test PYTEST_ARGS="-x tests/pipeline"
PY ?= python3
VENV ?= .venv
ARCHIVE ?= archive
SURVEY ?= docs/tutorials/first-visit.toml docs/tutorials/week-later.toml
PYTEST_ARGS ?= -n 3 --dist worksteal
BENCH ?=
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install -q --no-compile --disable-pip-version-check -c constraints.txt

# Ask the tools to send no analytics.
export DO_NOT_TRACK = 1

.PHONY: setup survey survey-rig picture test lint docs notebooks bench paper faults defects soak lock
.DEFAULT_GOAL := setup

setup: $(BIN)/.ok

# The pip that comes with Python 3.11 takes twice as long to resolve pinned versions as a new one.
# Debian without python3-venv has no ensurepip: create a bare environment, then install pip with the system's pip.
$(BIN)/.pip:
	$(PY) -m venv $(VENV) 2>/dev/null || { $(PY) -m venv --without-pip $(VENV) \
		&& $(PY) -m pip --python $(BIN)/python install -q pip; }
	$(PIP) -U pip
	touch $@

# Packages of a survey and those of tests, lint, pages and benchmarks, by one command: two take half as long again.
$(BIN)/.ok-dev: pyproject.toml constraints.txt | $(BIN)/.pip
	$(PIP) -e '.[dev,s3,bench]'
	touch $@

# A small survey checks the installation, and compiles what surveys import: larger ones then begin at once.
$(BIN)/.ok: pyproject.toml constraints.txt | $(BIN)/.pip $(if $(filter-out setup survey,$(MAKECMDGOALS)),$(BIN)/.ok-dev)
	[ $(BIN)/.ok-dev -nt pyproject.toml ] && [ $(BIN)/.ok-dev -nt constraints.txt ] || $(PIP) -e .
	small=$$(mktemp -d); PYTHONDONTWRITEBYTECODE= $(BIN)/spectralzoom survey --scene farm --size 64x64 --seconds 2 \
		--out $$small/archive > $$small/log 2>&1 || { cat $$small/log; exit 1; }; rm -rf $$small
	touch $@

# Surveys the built-in trial, and again a week later with the first map as prior map; or by other settings and flags.
survey: $(BIN)/.ok
	$(BIN)/spectralzoom survey $(SURVEY) --out $(ARCHIVE)

# Runs a survey through a fake rig, and compares it with the simulated one.
survey-rig: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/flows/surveys/test_survey_rig.py -k lines_of_the_simulation

# Makes the first picture of README and pages: the quicklook of the first visit of `make survey`.
picture: $(BIN)/.ok
	folder=$$(mktemp -d); $(BIN)/spectralzoom survey $(firstword $(SURVEY)) --out $$folder && cp $$folder/runs/*/quicklook.png docs/pictures/survey.png; rm -rf $$folder

# Property tests draw the same cases each time; PYTEST_ARGS="-n 3 --hypothesis-profile=anew" draws new ones.
# Tests start hundreds of processes, so they write bytecode even if the environment disables it.
test: $(BIN)/.ok-dev $(BIN)/.ok
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q $(PYTEST_ARGS)

lint: $(BIN)/.ok-dev
	$(BIN)/ruff check .
	$(BIN)/ruff check --select D --ignore D105 --config 'lint.pydocstyle.convention="numpy"' src
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Builds docs/_build/index.html. A dead link, anchor or reference is an error. Nothing is downloaded.
docs: $(BIN)/.ok-dev
	$(BIN)/python -m sphinx -q -E -W --keep-going -n -d docs/_build/.doctrees docs docs/_build

# Runs the notebooks of docs/ and stores their outputs. The tests run them without a kernel.
notebooks: $(BIN)/.ok
	$(PIP) nbclient ipykernel
	$(BIN)/python -c "$$RENDER" docs/notebooks/*.ipynb

# Compares every goal with its peers (BENCH="geometry resample" selects some), then prints error against time.
bench: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks $(BENCH); crashed=$$?; \
		OMP_NUM_THREADS=1 $(BIN)/spectralzoom tradeoff && exit $$crashed

PAPER ?=

# Prints tables II and III of the paper and checks its claim on 35 % of the patches. Ten minutes.
# PAPER="--data FOLDER" reads your own images and labels, PAPER="--steps 1200" trains longer.
paper: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/bench_paper.py $(PAPER)

FAULTS ?=

# Runs the fault-injection tests of the archive (FAULTS="disk_full files" selects some). Half an hour.
# `make test` runs a quick part of each.
faults: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/faults $(FAULTS)

DEFECTS ?=

# Applies ninety seeded defects to copies of the source, one at a time, and prints the share that a test catches
# (DEFECTS="--only archive" selects some). Twenty minutes.
defects: $(BIN)/.ok-dev
	$(BIN)/python tests/defects $(DEFECTS)

KILLS ?= 100

# Kills surveys at random moments (KILLS=100) and runs them again, which must end in the same stores.
soak: $(BIN)/.ok-dev
	KILLS=$(KILLS) OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q tests/faults/test_stopped.py -k killed_survey

# Writes names and versions to constraints.txt. With a CPU wheel of torch, pip does not resolve the accelerator's
# packages; their lines stay unchanged.
lock:
	$(PY) -m venv $(VENV)-lock 2>/dev/null || { $(PY) -m venv --without-pip $(VENV)-lock \
		&& $(PY) -m pip --python $(VENV)-lock/bin/python install -q pip; }
	$(VENV)-lock/bin/python -m pip install -q --dry-run --ignore-installed --report $(VENV)-lock/report.json '.[dev,s3,notebooks,bench]'
	$(VENV)-lock/bin/python -c "$$LOCK" $(VENV)-lock/report.json constraints.txt
	rm -rf $(VENV)-lock

define LOCK
import json, pathlib, re, sys
report, target = map(pathlib.Path, sys.argv[1:])
head, *old = target.read_text().splitlines()
kept = [line for line in old if re.match(r"nvidia-|cuda-|triton==", line)]
found = (item["metadata"] for item in json.loads(report.read_text())["install"])
lines = {line.split("==")[0]: line for line in kept}
for item in found:
    name = re.sub(r"[-_.]+", "-", item["name"]).lower()
    lines[name] = name + "==" + item["version"].split("+")[0]
lines.pop("spectralzoom", None)
target.write_text("\n".join([head, *(lines[name] for name in sorted(lines))]) + "\n")
endef
export LOCK

define RENDER
import sys
import nbclient, nbformat
for name in sys.argv[1:]:
    notebook = nbformat.read(name, 4)
    nbclient.NotebookClient(notebook, record_timing=False).execute()
    nbformat.write(notebook, name)
endef
export RENDER
