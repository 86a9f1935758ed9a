# Set-up happens by itself: every target that needs the environment makes it first.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

# The tests go two at a time: what computes makes way for what runs against the clock, over processes and sockets.
# What both use is compiled before, so that it is not compiled twice.
COMPUTING := tests/estimator tests/sims

.PHONY: help demo test test-computing test-running lint bench lock clean

help: ## what there is
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*##/\t/' | expand -t 12

$(READY): pyproject.toml requirements.lock
	@if command -v uv >/dev/null 2>&1; then \
	    uv venv --quiet --allow-existing --python "$$($(PYTHON) -c 'import sys; print(sys.executable)')" $(VENV) && \
	    uv pip install --quiet --python $(BIN)/python --require-hashes -r requirements.lock && \
	    uv pip install --quiet --python $(BIN)/python --no-deps -e . ; \
	else \
	    $(PYTHON) -m venv $(VENV) && \
	    $(BIN)/pip install -qq --disable-pip-version-check --require-hashes -r requirements.lock && \
	    $(BIN)/pip install -qq --disable-pip-version-check --no-deps -e . ; \
	fi
	@touch $@

demo: $(READY) ## fly a simulated aircraft, record, smooth and compare with the truth
	$(BIN)/sortie demo

test: $(READY) ## run the tests: two halves at a time, each is shown when it is through
	@$(BIN)/python -c "from estimator import stage; stage.warm_up(); stage.warm_up(stage.Settings(estimator='cubature'))"
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target test-computing test-running

test-computing: $(READY)
	nice -n 5 $(BIN)/python -m pytest -q $(COMPUTING)

test-running: $(READY)
	@$(BIN)/python -c "from telemetry import ingest, mavlink; ingest.warm_up(mavlink.Dialect())"
	$(BIN)/python -m pytest -q tests $(COMPUTING:%=--ignore=%)

lint: $(READY) ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: $(READY) ## where the time of a smoothing goes
	$(BIN)/sortie bench smooth

lock: $(READY) ## renew requirements.lock from pyproject.toml
	uv pip compile pyproject.toml --group dev --universal --generate-hashes --python-version 3.11 --quiet \
	    --no-header -o requirements.lock

clean: ## remove the environment and what tools left behind
	rm -rf $(VENV) .pytest_cache .ruff_cache .mypy_cache .hypothesis
