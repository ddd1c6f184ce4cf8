# Each target does all of its own set-up; it needs only python3 with venv and pip.

PYTHONS := 3.14 3.13 3.12 3.11
PYTHON ?= $(shell sh tools/python.sh $(PYTHONS))
# PyTorch is there for this one, and the oldest versions of dependencies are.
OLDEST_PYTHON ?= $(shell sh tools/python.sh 3.11)
BIN := .venv/bin
# Tests start hundreds of processes, each of which would compile the library anew where this is set.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo plan matrix pension check test test-parts test-thorough test-studies test-all test-wheel test-templates test-pythons test-language test-openenv test-openai test-trl test-negotiation test-clients test-benchmarl test-rllib test-wrappers test-browser test-oldest test-clusters test-outside release coverage mutants soak lint docs benchmark clean

demo: .venv/.demo
	$(BIN)/python -m examples.greenhouse_coop.train
	$(BIN)/python -m studies.demo.picture examples/greenhouse_coop/out/greenhouse.json

plan: .venv/.demo
	$(BIN)/python -m examples.greenhouse_coop.plan
	$(BIN)/python -m studies.demo.picture examples/greenhouse_coop/out/plan.json

# Runs only what is missing. MATRIX="--quick --out /tmp/matrix"
matrix: .venv/.matrix
	$(BIN)/python -m studies.greenhouse_matrix.matrix $(MATRIX)

# These fork all the time, and a fork takes four times as long in a process in which all the other tests run.
FORKING := tests/planning tests/seats tests/test_branch.py tests/test_clone.py docs/branches.md docs/seats.md docs/reference/planning.md
# What test-studies runs, and what test-outside runs because it needs more than a compiler.
STUDIES := tests/studies tests/test_benchmarks.py
ELSEWHERE := $(STUDIES) $(addprefix tests/outside/test_,$(addsuffix .py,energyplus enki fmi ros))
# Tests that are marked thorough, and most random examples, are left to test-thorough: see docs/contributing.md.
EXTENT := quick
test: .venv/.test
	$(MAKE) --jobs 2 --output-sync lint docs
	$(MAKE) test-parts

test-parts: .venv/.test
	$(BIN)/python -m pytest -n 2 --dist worksteal --order random --extent $(EXTENT) $(FORKING)
	$(BIN)/python -m pytest -n 2 --dist worksteal --order random --extent $(EXTENT) \
	    $(addprefix --ignore=,$(FORKING) $(ELSEWHERE) $(PAGE_TESTS))

test-thorough: .venv/.test
	$(MAKE) test-parts EXTENT=thorough

# One quick run of each study, from its command line to its figures, and of the benchmark.
test-studies: .venv/.test .venv-bounds/.bounds
	$(BIN)/python -m pytest -n 2 $(STUDIES)
	.venv-bounds/bin/python -m pytest tests/studies/test_bounds.py

# All tests. Run it before a release: it takes more than an hour on two cores.
test-all: test test-thorough test-studies test-wheel test-oldest test-templates test-pythons test-language test-clients test-rllib test-wrappers test-browser test-clusters test-outside

# The quickest tests, for each commit: about a minute on two cores, once the environment is there.
CHECK_TESTS := tests/test_definitions.py tests/test_registration.py tests/test_repository.py tests/test_stepped.py \
	$(addprefix tests/contract/test_,$(addsuffix .py,conformance environments episodes errors identity joint many_agents \
	one_agent rounds simulate)) \
	tests/core/test_spaces.py tests/envs/test_vector.py tests/hooks/test_points.py
check: lint
	$(BIN)/python -m pytest --quiet -n 2 $(CHECK_TESTS)

# Experiments with the pension fund. Runs only what is missing. PENSION="--quick --out /tmp/pension"
pension: .venv/.matrix
	$(BIN)/python -m studies.pension.study $(PENSION)

coverage: .venv/.test
	$(BIN)/python -m pytest --cov --cov-report=term

# Mutation tests: puts small mistakes into a copy of the library, one at a time, and reports which of them no test finds.
# MUTANTS="--number 20"
mutants: .venv/.test
	$(BIN)/python -m tools.mutants $(MUTANTS)

soak: .venv/.test
	$(BIN)/python -m benchmarks.soak --driver greenlet
	$(BIN)/python -m benchmarks.soak --driver thread

# Tests with real learners. RLlib pins an older Gymnasium than the others need, and BenchMARL an older TorchRL, so both have
# their own virtual environments.
CLIENTS ?= tests/clients
RECIPES := tests/clients/test_serial_supply.py -k recipe
test-clients: .venv-clients/.clients
	OMP_NUM_THREADS=1 .venv-clients/bin/python -m pytest $(CLIENTS) \
	    --ignore tests/clients/test_rllib.py --ignore tests/clients/test_supersuit.py
	test "$(CLIENTS)" != tests/clients || $(MAKE) test-benchmarl

test-benchmarl: .venv-benchmarl/.benchmarl
	OMP_NUM_THREADS=1 .venv-benchmarl/bin/python -m pytest $(RECIPES)

test-rllib: .venv-rllib/.rllib
	OMP_NUM_THREADS=1 RAY_USAGE_STATS_ENABLED=0 .venv-rllib/bin/python -m pytest tests/clients/test_rllib.py tests/clients/test_experiment.py
	OMP_NUM_THREADS=1 RAY_USAGE_STATS_ENABLED=0 .venv-rllib/bin/python -m pytest $(RECIPES)

# SuperSuit, and the dependencies of those wrappers of Gymnasium and PettingZoo that make videos, windows and tensors.
test-wrappers: .venv-wrappers/.wrappers
	OMP_NUM_THREADS=1 .venv-wrappers/bin/python -m pytest tests/clients/test_supersuit.py tests/envs/test_wrappers.py

# The page of `play` in headless Chromium, which is installed where it is missing.
test-browser: .venv-browser/.browser
	test -x /usr/bin/chromium || (apt-get update --quiet && apt-get install --yes --quiet chromium)
	.venv-browser/bin/python -m pytest -rs tests/seats/play/test_browser.py

.venv-clients/.clients .venv-rllib/.rllib .venv-benchmarl/.benchmarl .venv-wrappers/.wrappers .venv-browser/.browser .venv-bounds/.bounds: pyproject.toml
	test -x $(@D)/bin/python || $(OLDEST_PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check --editable '.[$(subst .,,$(@F))]'
	touch $@

# Language models: trainers and frameworks that pin other packages, each in its own virtual environment.
test-language: test-openenv test-openai test-trl test-negotiation

test-openenv: .venv-openenv/.openenv
	.venv-openenv/bin/python -m pytest tests/language

# Trainers pin the client's version 2.
test-openai: .venv-openai/.experiments
	for version in 2 3; do \
	    .venv-openai/bin/pip install --quiet --disable-pip-version-check --upgrade "openai==$$version.*" || exit; \
	    .venv-openai/bin/python -m pytest --quiet tests/seats/test_language.py tests/seats/test_tables.py || exit; \
	done

.venv-openenv/.openenv .venv-openai/.experiments: pyproject.toml
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check --editable '.[$(subst .,,$(@F))]' hypothesis pytest simpy
	touch $@

# The pages' examples. The second one is in no wheel, and needs Python 3.12; without that, it is skipped.
test-trl: .venv-trl/.trl
	HF_HUB_OFFLINE=1 TRL_EXPERIMENTAL_SILENCE=1 .venv-trl/bin/python docs/battery_trl.py

test-negotiation:
	sh tools/negotiation.sh

.venv-trl/.trl: pyproject.toml
	test -x $(@D)/bin/python || $(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check torch==2.13.0
	$(@D)/bin/pip install --quiet --disable-pip-version-check --editable . 'trl>=1.16'
	touch $@

# The oldest supported versions of all dependencies, with the tests of the order of events.
OLDEST_TESTS := $(addprefix tests/contract/test_,$(addsuffix .py,conformance ends environments episodes errors goals_and_time identity \
	joint many_agents mesa rounds side_by_side simulate simulate_many)) \
	tests/core/test_drivers.py tests/envs/test_vector.py tests/examples/test_mesa_models.py \
	tests/many/test_workers.py tests/test_definitions.py
test-oldest: .venv-oldest/.oldest
	.venv-oldest/bin/python -m pytest --driver greenlet $(OLDEST_TESTS)

.venv-oldest/.oldest: pyproject.toml tests/oldest.txt
	test -x $(@D)/bin/python || $(OLDEST_PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check --constraint tests/oldest.txt --editable '.[many]' hypothesis 'mesa[network]' pytest simpy
	touch $@

# What is published. The wheel is tested with what the source distribution contains, but for the sources: nothing can stand
# in for what the wheel lacks.
TESTED_WITH := cffi gevent hypothesis mesa[network] pillow pytest pytest-xdist simpy trio
WHEEL_TESTS := $(CHECK_TESTS) tests/many/test_workers.py tests/test_command_line.py tests/examples/test_greenhouse.py README.md
test-wheel:
	rm -rf dist build/sdist
	test -x .venv-wheel/bin/python || $(PYTHON) -m venv .venv-wheel
	.venv-wheel/bin/pip install --quiet --disable-pip-version-check build pyyaml twine
	.venv-wheel/bin/python -m build --outdir dist .
	.venv-wheel/bin/twine check --strict dist/*
	.venv-wheel/bin/pip uninstall --quiet --yes simenv-marl
	.venv-wheel/bin/pip install --quiet --disable-pip-version-check "$$(echo dist/*.whl)[demo,experiments]" $(TESTED_WITH)
	.venv-wheel/bin/python -m pytest --quiet tests/distribution
	mkdir -p build/sdist && tar -xzf dist/*.tar.gz --strip-components 1 -C build/sdist && rm -r build/sdist/src
	cd build/sdist && ../../.venv-wheel/bin/python -m pytest --quiet -n 2 --driver greenlet $(WHEEL_TESTS)

# Builds and tests what is published, builds it again to compare the bytes, and prints the command that uploads it.
release: test-wheel test-templates
	.venv-wheel/bin/python -m build --outdir build/again .
	.venv-wheel/bin/python -m tools.release

# Each supported Python, but for the one of .venv. What is not found is told of.
test-pythons:
	sh tools/pythons.sh "$(TESTED_WITH)" \
	    "tests/contract tests/core tests/data/test_collected.py tests/data/test_rule_actions.py tests/envs" \
	    $(filter-out $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])'),$(PYTHONS))

# Local clusters, on the loopback address only. Each has its own virtual environment, because of its pinned versions.
test-clusters: .venv-dask/.experiments .venv-ray/.experiments
	.venv-dask/bin/python -m tests.clusters.check dask
	RAY_USAGE_STATS_ENABLED=0 .venv-ray/bin/python -m tests.clusters.check ray

.venv-dask/.experiments: CLUSTER := dask[distributed]>=2025.1
.venv-ray/.experiments: CLUSTER := ray>=2.40
.venv-dask/.experiments .venv-ray/.experiments: pyproject.toml
	test -x $(@D)/bin/python || $(OLDEST_PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check --editable '.[experiments]' '$(CLUSTER)'
	touch $@

# Simulators outside Python: in C++, Java, ns-3, Enki, ROS, EnergyPlus, FMI. Reports and skips what cannot be installed here.
test-outside: .venv/.test
	sh tools/outside.sh
	for extra in energyplus fmi; do \
	    $(BIN)/pip install --quiet --disable-pip-version-check --editable ".[$$extra]" || \
	        echo "the extra $$extra cannot be installed; its tests are skipped" >&2; \
	done
	$(BIN)/python -m pytest -n 2 -rs tests/outside

# The built wheel, on the newest and the oldest Python that are there: templates from an empty folder, and the newest Mesa.
test-templates:
	sh tools/templates.sh $(PYTHONS)
	sh tools/templates.sh 3.11

lint: .venv/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Links, the map, words, names in the reference, and whether tests run the commands that pages show.
PAGE_TESTS := tests/test_pages.py
docs: .venv/.test
	$(BIN)/sphinx-build --fail-on-warning --quiet docs docs/_build
	$(BIN)/python -m pytest --quiet $(PAGE_TESTS)

benchmark: .venv/.test
	$(BIN)/python -m benchmarks.core

# A marker file for each set of dependencies: make installs them again when pyproject.toml has changed.
.venv/.%: pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check --editable '.[$*]'
	touch $@

clean:
	rm -rf .venv .venv-* .mutants build dist docs/_build

# One policy for all sheep of Mesa's model: trains it, compares it, and writes the figures to docs/figures.
.PHONY: wolf-sheep
wolf-sheep: .venv-clients/.clients
	OMP_NUM_THREADS=1 .venv-clients/bin/python -m examples.wolf_sheep.train
	OMP_NUM_THREADS=1 .venv-clients/bin/python -m studies.wolf_sheep.results
	.venv-clients/bin/python -m studies.wolf_sheep.picture

# The whole cooperative experiment: less than half an hour on two cores. Runs only what is missing.
.PHONY: experiment
EXPERIMENT := studies.greenhouse_experiment
EXPERIMENT_OUT ?= studies/greenhouse_experiment/out
EXPERIMENT_WORKERS ?= 2
experiment: export OMP_NUM_THREADS = 1
experiment: .venv-clients/.clients .venv-rllib/.rllib
	for script in baselines sb3 torchrl; do \
	    $(<D)/bin/python -m $(EXPERIMENT).$$script --out $(EXPERIMENT_OUT) --workers $(EXPERIMENT_WORKERS) || exit; \
	done
	.venv-rllib/bin/python -m $(EXPERIMENT).rllib --out $(EXPERIMENT_OUT) --workers $(EXPERIMENT_WORKERS)
	$(<D)/bin/python -m $(EXPERIMENT).results --runs $(EXPERIMENT_OUT)
	$(<D)/bin/python -m $(EXPERIMENT).back_in_the_model $(EXPERIMENT_OUT)/sb3-3-0.zip $(EXPERIMENT_OUT)/torchrl-4b-0.pt
	.venv-rllib/bin/python -m $(EXPERIMENT).back_in_the_model $(EXPERIMENT_OUT)/rllib-4a-0
