# Set-up, the main job, tests, documentation and releases, each from a clone with only python3 and
# make. On Linux, PyTorch's CUDA build takes 5 GB; the CPU's takes 0.7 GB:
#   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make train

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# The versions that the tests passed with are of Python 3.11
LOCK = $(shell $(BIN)/python -c 'import sys; print("-c constraints.txt" * (sys.version_info[:2] == (3, 11)))')
PIP = $(BIN)/python -m pip install --quiet $(LOCK)
# A stamp for each set of packages that is installed
RUN := $(VENV)/.run
DEV := $(VENV)/.installed
DOCS := $(VENV)/.docs
EXTRAS := extra,robotics,box2d,zoo

.PHONY: venv train test lint format docs tables matrix lock dist clean

venv: $(DEV)

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

# 25.1 brought --group
$(VENV)/.pip: | $(BIN)/python
	$(BIN)/python -m pip install --quiet --upgrade "pip>=25.1"
	@touch $@

$(RUN): pyproject.toml constraints.txt | $(VENV)/.pip
	@echo "Installing sb3-crpn, PyTorch, Matplotlib and the progress bar into $(VENV) (once) ..."
	$(PIP) --editable ".[extra]"
	@touch $@

$(DEV): pyproject.toml constraints.txt | $(VENV)/.pip
	@echo "Installing sb3-crpn with all extras and the development tools into $(VENV) (once) ..."
	$(PIP) --editable ".[$(EXTRAS)]" --group dev
	@touch $@ $(RUN)

$(DOCS): $(DEV)
	@echo "Installing Sphinx into $(VENV) (once) ..."
	$(PIP) --group docs
	@touch $@

train: $(RUN)
	$(BIN)/python examples/cartpole.py

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: lint
	OMP_NUM_THREADS=1 $(BIN)/pytest --numprocesses auto --cov --cov-fail-under 95

format: venv
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Warnings are errors: a broken link or a docstring that does not parse fails the build
docs: $(DOCS)
	$(BIN)/python -m sphinx -W --keep-going -b html docs build/docs
	@echo "build/docs/index.html"

# The tables of README.md and docs/, from the committed measurements
tables: venv
	$(BIN)/python -m benchmarks.documentation

# Every supported Python, with the oldest and with the newest dependencies: see noxfile.py.
# TESTS=tests runs the whole suite in each cell
matrix: venv
	$(BIN)/nox -- $(TESTS)

# The versions that the tests passed with; "+cpu" names a build, not a version
lock: $(DOCS)
	echo '# The versions that the tests passed with (Python 3.11); made by `make lock`' > constraints.txt
	$(BIN)/pip freeze --all --exclude pip --exclude-editable | sed 's/+cpu//' >> constraints.txt

dist: venv
	$(BIN)/python -m hatchling build

clean:
	rm -rf $(VENV) runs build dist .nox .mypy_cache .ruff_cache .pytest_cache .hypothesis
