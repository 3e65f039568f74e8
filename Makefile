# The newcomer's commands: make demo, make test. Each sets up what it needs in .venv.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
BIN := .venv/bin
# A clone shares no compiled kernels with another, and keeps its own between runs.
export NUMBA_CACHE_DIR ?= $(CURDIR)/.venv/numba-cache

.PHONY: install demo run test lint bench openapi clean

install: .venv/.dev

.venv/bin/python:
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --upgrade pip

.venv/.server: .venv/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[server]'
	touch $@

.venv/.dev: .venv/bin/python pyproject.toml
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[dev]'
	touch $@ .venv/.server

demo: .venv/.server
	$(BIN)/specshield demo

run: .venv/.server
	$(BIN)/specshield serve

test: .venv/.dev
	$(BIN)/python -m pytest

lint: .venv/.dev
	$(BIN)/ruff check app tests benchmarks
	$(BIN)/ruff format --check app tests benchmarks
	$(BIN)/mypy
	$(BIN)/lint-imports

# What only the benchmarks need stays out of .venv; the rest they take from it.
.venv-bench/.done: .venv/.dev benchmarks/requirements.txt
	$(BIN)/python -m venv .venv-bench
	$(BIN)/python -c "import sysconfig as s; print(f'import site; site.addsitedir({s.get_path(\"purelib\")!r})')" \
	  > $$(.venv-bench/bin/python -c "import sysconfig as s; print(s.get_path('purelib'))")/project.pth
	.venv-bench/bin/python -m pip install --quiet --disable-pip-version-check -r benchmarks/requirements.txt
	touch $@

bench: .venv-bench/.done
	.venv-bench/bin/python -m benchmarks $(ARGS)

openapi: .venv/.server
	$(BIN)/specshield openapi > openapi.json

clean:
	rm -rf .venv .venv-bench build out
