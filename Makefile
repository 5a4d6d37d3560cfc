# NeuFace Asset. `make` or `make help` lists what there is.
PYTHON ?= python3.11
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= out/demo
export OMP_WAIT_POLICY ?= PASSIVE
export DO_NOT_TRACK := 1

.DEFAULT_GOAL := help
.PHONY: help setup demo test check lint format bench lock clean

help: ## this list
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-8s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(VENV)/.ready ## sets up what is missing, then photos of a made-up head -> asset + report, checked against the truth
	$(BIN)/neuface demo --out $(OUT)

# So many processes run the tests; auto: one per core, at most 4, as far as the memory goes. Each file stays in one of
# them, so that what its tests share is made once, and the files with slow tests come first (tests/support/spread.py).
WORKERS ?= auto
SPREAD = -n $(WORKERS) --dist loadfile --no-loadscope-reorder
test: $(VENV)/.ready-dev ## sets up what is missing, then every test
	$(BIN)/python -m pytest -q --durations=10 $(SPREAD)

check: lint ## format, lint, types, import rules, and the tests that are quick
	$(BIN)/python -m pytest -q -m "not slow" $(SPREAD)

lint: $(VENV)/.ready-dev ## format, lint, types and import rules
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy --num-workers 2
	$(BIN)/lint-imports

format: $(VENV)/.ready-dev ## puts the code into shape
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.ready ## speed and accuracy on this machine: the demo, timed stage by stage in out/bench/run.json
	$(BIN)/neuface demo --out out/bench

setup: $(VENV)/.ready-dev ## the environment in .venv, with the tools for development

$(BIN)/python:
	@command -v $(PYTHON) >/dev/null || { echo "$(PYTHON) is not installed: install Python 3.11 with its venv module," \
		"or name another with 'make PYTHON=...'" >&2; exit 1; }
	$(PYTHON) -m venv $(VENV)

# A stamp each, so that the set-up happens once per change of a lock.
$(VENV)/.ready: requirements.lock pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps -e .
	@touch $@

$(VENV)/.ready-dev: $(VENV)/.ready requirements-dev.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -r requirements-dev.lock
	@touch $@

# torch's CPU builds carry a local version label ("+cpu") that only some package sources know: it is cut off.
COMPILE = $(BIN)/pip-compile --quiet --strip-extras --no-header --annotation-style=line \
	--no-emit-index-url --no-emit-find-links --no-emit-trusted-host
lock: $(VENV)/.ready-dev ## the newest versions that pyproject allows, into the lock files
	$(COMPILE) --upgrade -o requirements.lock pyproject.toml
	$(COMPILE) --upgrade --extra dev -c requirements.lock -o requirements-dev.lock pyproject.toml
	sed -i -e 's/+cpu//' -e '1i # Exact versions of all that pyproject needs; made by `make lock`. Without hashes: every package source has' \
		-e '1i # its own build of torch. Where only the CUDA build is found, that one gets installed.' requirements*.lock

clean: ## removes what was built here (not .venv, not your runs)
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find pipeline stages workflows tests benchmarks -name __pycache__ -type d -exec rm -rf {} +
