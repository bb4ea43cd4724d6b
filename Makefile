# SpectralZoom: setup, survey, survey-rig, test, lint, docs, notebooks, bench, paper, faults, soak, lock.
#   make survey ARCHIVE=/data/field7    make test PY=python3.12 VENV=/tmp/venv    make test PYTEST_ARGS="-x tests/pipeline"
PY ?= python3
VENV ?= .venv
ARCHIVE ?= archive
SCENE ?= farm
SECONDS ?= 25
PYTEST_ARGS ?= -n 3 --dist worksteal
BENCH ?=
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install -q --no-compile --disable-pip-version-check -c constraints.txt

# The tools beneath are asked to send no analytics.
export DO_NOT_TRACK = 1

.PHONY: setup survey survey-rig test lint docs notebooks bench paper faults soak lock
.DEFAULT_GOAL := setup

setup: $(BIN)/.ok

# Debian without python3-venv has no ensurepip: make the environment bare, then let the system's pip fill it.
$(BIN)/.ok: pyproject.toml constraints.txt
	$(PY) -m venv $(VENV) 2>/dev/null || { $(PY) -m venv --without-pip $(VENV) \
		&& $(PY) -m pip --python $(BIN)/python install -q pip; }
	$(PIP) -e .
	touch $@

# What tests, lint, pages and benchmarks need on top.
$(BIN)/.ok-dev: $(BIN)/.ok
	$(PIP) -e '.[dev,s3,bench]'
	touch $@

# A visit, and of the built-in farm the visit a week later, which goes on from the map of the first.
survey: $(BIN)/.ok
	$(BIN)/spectralzoom survey --scene $(SCENE) --seconds $(SECONDS) --out $(ARCHIVE)
ifeq ($(SCENE),farm)
	$(BIN)/spectralzoom survey --scene farm --day 179 --seconds 8 --prior latest --no-controls --out $(ARCHIVE)
endif

# A rig emulated behind a pty and sockets, a whole survey through it, and the simulated one beside it. About a minute.
survey-rig: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/soak survey-rig

# Laws draw the same cases each time; PYTEST_ARGS="-n 3 --hypothesis-profile=anew" draws others.
# Tests start hundreds of processes: bytecode is kept between them, also where the environment says otherwise.
test: $(BIN)/.ok-dev
	PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -q $(PYTEST_ARGS)

lint: $(BIN)/.ok-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The pages of docs/ as docs/_build/index.html. A dead link, anchor or reference fails; nothing is fetched.
docs: $(BIN)/.ok-dev
	$(BIN)/python -m sphinx -q -E -W --keep-going -n -d docs/_build/.doctrees docs docs/_build

# The notebooks of docs/, run from top to bottom and kept with what they gave. The tests run them without a kernel.
notebooks: $(BIN)/.ok
	$(PIP) nbclient ipykernel
	$(BIN)/python -c "$$RENDER" docs/notebooks/*.ipynb

# Every goal with the peers beside it (BENCH="geometry lookup" for some), then what accuracy costs in time.
bench: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks $(BENCH); crashed=$$?; \
		OMP_NUM_THREADS=1 $(BIN)/spectralzoom tradeoff && exit $$crashed

PAPER ?=

# Ten minutes: tables II and III of the paper, and whether 35 % of the patches score as much as all of them
# (PAPER="--data FOLDER" for images and labels of your own, PAPER="--steps 1200" for longer training).
paper: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/benchmarks/bench_paper.py $(PAPER)

FAULTS ?=

# Half an hour: everything that may go wrong with an archive, by the hundred (FAULTS="disk_full clocks" for some);
# the tests hold a quick part of each.
faults: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/faults $(FAULTS)

SOAK ?=

# Under an hour: a day of 72 surveys with kills, cables and full disks, and a week on Prefect's schedules
# (SOAK="day --quick").
soak: $(BIN)/.ok-dev
	OMP_NUM_THREADS=1 $(BIN)/python tests/soak $(SOAK)

# Names and versions only. A machine that is offered a CPU wheel of torch does not resolve the accelerator's packages:
# their lines are kept as they are.
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
