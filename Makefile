# The newcomer's commands: make demo, make test. Each sets up what it needs in .venv.
# Any Python from 3.11 on.
PYTHON ?= $(shell for name in python3.11 python3 python3.12 python3.13 python3.14; do \
  $$name -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && command -v $$name && break; done)
BIN := .venv/bin
# A clone shares no compiled kernels with another, and keeps its own between runs.
export NUMBA_CACHE_DIR ?= $(CURDIR)/.venv/numba-cache
# Its tests start some 200 processes; without bytecode on the disk each compiles all that it imports.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: install demo run test wheels lowest lint lines docs bench reliability results openapi clean

install: .venv/.dev

.venv/bin/python:
	@test -n "$(PYTHON)" || { echo "specshield needs Python 3.11 or later: make PYTHON=/path/to/python3.12"; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip

.venv/.server: .venv/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[server]'
	touch $@

.venv/.dev: .venv/bin/python pyproject.toml evaluation/pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]' -e ./evaluation
	touch $@ .venv/.server

demo: .venv/.server
	$(BIN)/specshield demo $(ARGS)

run: .venv/.server
	$(BIN)/specshield serve

# One thread for each process: with two for each of four, numpy's and torch's spend their time in waiting for each other.
test: export OMP_NUM_THREADS = 1
test: .venv/.dev
	$(BIN)/python -m specshield.service.startup  # or each of six processes would compile what a server needs
	$(BIN)/python -m pytest -n 6 --dist loadfile --no-loadscope-reorder  # each module's tests stay in one process; six keep two cores busy

# The wheels, into dist/: one that compiles at its first start, one that brings its kernels for this Python and
# processor. Both are installed in a new environment and run in an empty folder, as a newcomer would.
wheels: .venv/bin/python
	$(BIN)/python .ci/wheel.py

# The oldest packages that pyproject.toml allows, in a new environment.
lowest: .venv/bin/python
	$(BIN)/python .ci/lowest.py

lint: .venv/.dev
	$(BIN)/ruff check app evaluation tests benchmarks examples ros2 .ci
	$(BIN)/ruff format --check app evaluation tests benchmarks examples ros2 .ci
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m benchmarks.lines

# How long the code is: the part that the guarantee rests on, and the rest.
lines: .venv/bin/python
	$(BIN)/python -m benchmarks.lines

# What only the benchmarks need stays out of .venv; the rest they take from it.
.venv-bench/.done: .venv/.dev benchmarks/requirements.txt
	$(BIN)/python -m venv .venv-bench
	$(BIN)/python -c "import sysconfig as s; print(f'import site; site.addsitedir({s.get_path(\"purelib\")!r})')" \
	  > $$(.venv-bench/bin/python -c "import sysconfig as s; print(s.get_path('purelib'))")/project.pth
	.venv-bench/bin/python -m pip install --quiet --disable-pip-version-check -r benchmarks/requirements.txt
	touch $@

bench: .venv-bench/.done
	.venv-bench/bin/python -m benchmarks $(ARGS)

# The site of docs/ in out/site; ends where a link or a heading does not exist.
docs: .venv/.dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet

# docs/reliability.md; hours, best on a machine that nobody else uses. What is in out/reliability is not run again, and a part
# that has no figures there stays as the page has it.
RELIABILITY = $(BIN)/python -m benchmarks.reliability
reliability: .venv-bench/.done
	-$(RELIABILITY) faults --resume
	-$(RELIABILITY) isolation --resume
	-test -f out/reliability/load.json || $(RELIABILITY) load
	-test -f out/reliability/contract.json || $(RELIABILITY) contract
	-$(RELIABILITY) elsewhere --resume
	-$(RELIABILITY) fuzz
	$(RELIABILITY) report

# docs/results.md with the pages that it links to, in less than 90 minutes on two free cores. What is in RESULTS already
# is not done again. A first look at the campaigns, a tenth of their runs:
# make results ARGS='--share 0.1' RESULTS=/tmp/try PAGES=/tmp/try-pages
RESULTS ?= out/results
PAGES ?= docs
HOUSES ?= ../shared/data/houses
results: .venv/.dev
	@echo "begun: $$(date)"
	$(BIN)/python -m evaluation results --out $(RESULTS) --page $(PAGES)/results.md --houses $(HOUSES) $(ARGS)
	$(BIN)/python -m evaluation curves --runs 24 --out $(RESULTS)-curves --page $(PAGES)/curves.md
	$(BIN)/python -m evaluation habits --runs 30 --out $(RESULTS)-habits --page $(PAGES)/habits.md
	$(BIN)/python -m evaluation rivals --runs 16 --seed 7 --out $(RESULTS)-rivals --page $(PAGES)/rivals.md
	$(BIN)/python -m evaluation rewards --updates 6000 --runs 10 --out $(RESULTS)-rewards --page $(PAGES)/rewards.md
	@echo "done: $$(date)"

openapi: .venv/.server
	$(BIN)/specshield openapi > openapi.json

clean:
	rm -rf .venv .venv-bench build out
