# Each target does all of its own set-up: python3 with venv and pip is all it needs.

PYTHON ?= python3
BIN := .venv/bin

.PHONY: demo test test-clusters coverage soak lint docs benchmark clean

demo: .venv/.demo
	$(BIN)/python -m examples.greenhouse_coop.train

test: lint docs
	$(BIN)/python -m pytest

coverage: .venv/.test
	$(BIN)/python -m pytest --cov --cov-report=term

soak: .venv/.test
	$(BIN)/python -m benchmarks.soak --driver greenlet
	$(BIN)/python -m benchmarks.soak --driver thread

# Local clusters, on the loopback address alone. Each has an environment of its own, because of what it pins.
test-clusters: .venv-dask/.many .venv-ray/.many
	.venv-dask/bin/python -m tests.clusters.check dask
	RAY_USAGE_STATS_ENABLED=0 .venv-ray/bin/python -m tests.clusters.check ray

.venv-dask/.many: CLUSTER := dask[distributed]>=2025.1
.venv-ray/.many: CLUSTER := ray>=2.40
.venv-dask/.many .venv-ray/.many: pyproject.toml
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check --editable '.[many]' '$(CLUSTER)'
	touch $@

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
	rm -rf .venv .venv-dask .venv-ray docs/_build

# The cooperative experiment, all of it: less than half an hour on two cores. What is done already is not done again.
.PHONY: experiment
EXPERIMENT := examples.greenhouse_coop.experiment
EXPERIMENT_OUT ?= examples/greenhouse_coop/out/experiment
EXPERIMENT_WORKERS ?= 2
experiment: export OMP_NUM_THREADS = 1
experiment: .venv-experiment/.experiment .venv-experiment-rllib/.experiment-rllib
	for script in baselines sb3 torchrl; do \
	    $(<D)/bin/python -m $(EXPERIMENT).$$script --out $(EXPERIMENT_OUT) --workers $(EXPERIMENT_WORKERS) || exit; \
	done
	.venv-experiment-rllib/bin/python -m $(EXPERIMENT).rllib --out $(EXPERIMENT_OUT) --workers $(EXPERIMENT_WORKERS)
	$(<D)/bin/python -m $(EXPERIMENT).results --runs $(EXPERIMENT_OUT)
	$(<D)/bin/python -m $(EXPERIMENT).back_in_the_model $(EXPERIMENT_OUT)/sb3-3-0.zip $(EXPERIMENT_OUT)/torchrl-4b-0.pt
	.venv-experiment-rllib/bin/python -m $(EXPERIMENT).back_in_the_model $(EXPERIMENT_OUT)/rllib-4a-0

.venv-experiment/.experiment .venv-experiment-rllib/.experiment-rllib: pyproject.toml
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check --editable '.[$(subst .,,$(@F))]'
	touch $@
