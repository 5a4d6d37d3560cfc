# NeuFace Asset. `make` or `make help` lists what there is.
PYTHON ?= python3.11
VENV   := .venv
BIN    := $(VENV)/bin
OUT    ?= out/demo
export OMP_WAIT_POLICY ?= PASSIVE
export DO_NOT_TRACK := 1

.DEFAULT_GOAL := help
.PHONY: help setup demo test check lint format bench fuzz nightly lock sbom clean

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
# Every file is checked against the locks' hashes. A build of torch that requirements-torch.lock does not know is
# refused: `make setup TORCH_CHECK=` takes it unchecked. The third line adds the libraries that a CUDA build needs.
PIP = $(BIN)/python -m pip install --quiet --disable-pip-version-check
TORCH_CHECK ?= --require-hashes
$(VENV)/.ready: requirements.lock requirements-torch.lock pyproject.toml | $(BIN)/python
	$(PIP) --require-hashes --no-deps -r requirements.lock
	sed $(if $(TORCH_CHECK),,-n -e 's/ .*//' -e '/^torch/p') requirements-torch.lock > $(VENV)/torch.txt
	$(PIP) $(TORCH_CHECK) --no-deps -r $(VENV)/torch.txt
	$(PIP) "$$(sed -n 's/^\(torch==[^ ]*\).*/\1/p' requirements-torch.lock)"
	$(PIP) --no-deps -e .
	@touch $@

$(VENV)/.ready-dev: $(VENV)/.ready requirements-dev.lock
	$(PIP) --require-hashes --no-deps -r requirements-dev.lock
	@touch $@

sbom: $(VENV)/.ready ## a bill of materials of what is installed and shipped, in out/sbom.cdx.json
	$(BIN)/python -m workflows.supply.sbom --out out/sbom.cdx.json

fuzz: $(VENV)/.ready-dev ## an hour or more: 10,000 damaged files for every reader, counted; ONLY=cameras for some
	$(BIN)/python -m benchmarks.fuzz_counts $(if $(ONLY),--only $(ONLY))

nightly: $(VENV)/.ready-dev ## hours: 10,000 damaged files for every reader; every signal at every moment of a run
	NEUFACE_FUZZ=10000 $(BIN)/python -m pytest -q tests/fuzz $(SPREAD)
	$(BIN)/python -m benchmarks.kill_matrix out/signals

COMPILE = $(BIN)/pip-compile --quiet --strip-extras --no-header --generate-hashes --allow-unsafe \
	--no-emit-index-url --no-emit-find-links --no-emit-trusted-host
lock: $(VENV)/.ready-dev ## the newest versions that pyproject allows, into the lock files
	$(COMPILE) --upgrade -o requirements.lock pyproject.toml
	$(COMPILE) --upgrade --extra dev -c requirements.lock -o requirements-dev.lock pyproject.toml
	$(BIN)/python -m workflows.supply.relock .
	$(BIN)/python -m workflows.supply.sbom --write

clean: ## removes what was built here (not .venv, not your runs)
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis
	find pipeline stages workflows tests benchmarks -name __pycache__ -type d -exec rm -rf {} +
