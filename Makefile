# Each target does all of its own set-up: python3 with venv and pip is all it needs.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test coverage soak lint docs benchmark clean

demo: .venv/.demo
	$(BIN)/python -m examples.greenhouse_coop.train

test: lint docs
	$(BIN)/python -m pytest

coverage: .venv/.test
	$(BIN)/python -m pytest --cov --cov-report=term

soak: .venv/.test
	$(BIN)/python -m benchmarks.soak --driver greenlet
	$(BIN)/python -m benchmarks.soak --driver thread

lint: .venv/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: .venv/.test
	$(BIN)/sphinx-build --fail-on-warning --quiet docs docs/_build

benchmark: .venv/.test
	taskset -c 0 $(BIN)/python -m benchmarks.core

# A marker for each set of dependencies: installed anew when what is asked for has changed.
.venv/.%: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[$*]'
	touch $@

clean:
	rm -rf .venv docs/_build
