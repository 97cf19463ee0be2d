# Needs Python 3.10 or newer, git and make; everything else goes into a virtual environment of its own.
#
#   make demo     a mock swarm of 100 nodes, and what became of its data
#   make test     the tests
#   make soak     the long forms of the tests, and many more examples of properties
#   make lint     ruff and mypy (style, format and types by themselves)
#   make bench    the benchmarks
#   make paper    the paper's tables and figures, two runs of each kind, in build/paper (RUNS=30 for all of them)
#   make          only the environment for these, in .venv, with this checkout installed in it
#   make clean    removes .venv and what the tools left behind
#
# `make demo` creates a small environment, with what a node and the mock swarm need. The others add the tools to it.
# Another interpreter: make PYTHON=python3.12. Another place for the environment: make VENV=/some/where.

PYTHON ?= python3
VENV ?= .venv
# Tests that run at the same time: more than two cores, because many of them only wait for a real node.
JOBS ?= 3
# For `make paper`: runs of each kind, their length, and where the tables and figures go.
RUNS ?= 2
STEPS ?= 500
OUT ?= build/paper

# The tests start hundreds of interpreters. Without compiled files each would compile all that it imports.
unexport PYTHONDONTWRITEBYTECODE

BIN := $(VENV)/bin
# Compiled when first imported: most of what is installed never is.
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-compile
# Two files inside the environment say how far it is complete. It is created from nothing when what it is made from changes.
SMALL := $(VENV)/small
READY := $(VENV)/ready

.PHONY: install demo test soak lint style format types bench paper clean
.DELETE_ON_ERROR:

install: $(READY)

$(SMALL): requirements.lock requirements-demo.lock requirements-interop.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 10))' || \
		{ echo 'Python 3.10 or newer is needed: make PYTHON=python3.12' >&2; exit 1; }
	@echo 'Creating $(VENV) (once) ...'
	@if [ -e '$(VENV)/pyvenv.cfg' ]; then rm -rf '$(VENV)'; fi
	@$(PYTHON) -m venv '$(VENV)' || { echo 'On Debian and Ubuntu: sudo apt install python3-venv' >&2; exit 1; }
	@$(PIP) --no-deps --require-hashes -r requirements-demo.lock
	@$(PIP) --no-deps --no-build-isolation --editable .
	@touch '$(SMALL)'

$(READY): $(SMALL)
	@echo 'Adding the tools of the tests and figures to $(VENV) (once, half a minute) ...'
	@$(PIP) --no-deps --require-hashes -r requirements.lock
	@$(PIP) --no-deps --require-hashes -r requirements-interop.lock
	@touch '$(READY)'

demo: $(SMALL)
	@$(BIN)/rass-mav swarm

test: $(READY)
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal

soak: $(READY)
	@$(BIN)/python -m pytest -n $(JOBS) --dist worksteal -m 'soak or hypothesis' --hypothesis-profile soak

lint: style format types

style: $(READY)
	@$(BIN)/ruff check .

format: $(READY)
	@$(BIN)/ruff format --check .

types: $(READY)
	@$(BIN)/mypy

bench: $(READY)
	@$(BIN)/python -m benchmarks

paper: $(READY)
	@$(BIN)/rass-mav experiment paper --out '$(OUT)' --runs $(RUNS) --steps $(STEPS) --jobs $(JOBS)

clean:
	rm -rf .venv build dist *.egg-info .coverage .coverage.* .hypothesis .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
