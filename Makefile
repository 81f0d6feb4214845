# Set-up, the main job and the tests, each from a fresh clone with only python3 and make.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.PHONY: venv train test lint format lock clean

venv: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --constraint constraints.txt --editable ".[dev]"
	touch $(STAMP)

train: venv
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

# The versions that the tests passed with; "+cpu" names a build, not a version
lock: venv
	echo '# The versions that the tests passed with (Python 3.11); made by `make lock`' > constraints.txt
	$(BIN)/pip freeze --all --exclude pip --exclude-editable | sed 's/+cpu//' >> constraints.txt

clean:
	rm -rf $(VENV) runs dist .mypy_cache .ruff_cache .pytest_cache .hypothesis
