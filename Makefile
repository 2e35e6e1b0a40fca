PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PEERS := $(VENV)/.peers

.DEFAULT_GOAL := help
.PHONY: help install serve demo test bench contract faults soak screenshots lint lock openapi

help:  ## Show these targets
	@grep -hE '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

$(INSTALLED): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "AirMatrix needs Python 3.11 or newer; name one with PYTHON=..."; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --disable-pip-version-check --quiet --require-hashes -r requirements.lock
	$(BIN)/pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --editable .
	@touch $@

install: $(INSTALLED)  ## Create .venv with everything locked

serve: $(INSTALLED)  ## Run the service on http://127.0.0.1:8000
	$(BIN)/airmatrix serve

demo: $(INSTALLED)  ## Show it: a service, traffic, flying aircraft, and the console's address
	@$(BIN)/airmatrix demo

# Two processes halve the time; a file's tests stay together, for they share what is slow to set up.
test: $(INSTALLED)  ## Run the tests
	$(BIN)/pytest -n 2 --dist loadfile

# Without their dependencies, which are locked already or not needed to run: so the environment stays the tested one.
$(PEERS): $(INSTALLED) tests/benchmark/requirements.lock
	@$(BIN)/pip install --disable-pip-version-check --quiet --require-hashes --no-deps -r tests/benchmark/requirements.lock \
		&& touch $@ || echo "bench: the peers could not be installed (one needs a C++ compiler), so they are left out"

bench: $(INSTALLED) $(PEERS)  ## Time the planner; choose with PARTS="intents committed city peers"
	$(BIN)/python -m tests.benchmark.bench $(PARTS)

contract: $(INSTALLED)  ## Hold the service to its OpenAPI document at length; choose with EXAMPLES=1000 SEED=7
	$(BIN)/python -m tests.contract.campaign $(if $(EXAMPLES),--examples $(EXAMPLES)) $(if $(SEED),--seed $(SEED))

faults: $(INSTALLED)  ## Break the service in every way we know; choose with PARTS="kill disk ..." ROUNDS=20
	$(BIN)/python -m tests.faults.campaign $(PARTS) $(if $(ROUNDS),--rounds $(ROUNDS))

soak: $(INSTALLED)  ## A day of traffic in five minutes; choose with SECONDS=600
	$(BIN)/python -m tests.soak.soak $(SECONDS)

screenshots: $(INSTALLED)  ## Renew the README's pictures of the console (needs chromium)
	AIRMATRIX_SCREENSHOTS=1 $(BIN)/pytest -q tests/console/test_screenshots.py

lint: $(INSTALLED)  ## Check style, types, layers and the container files
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/hadolint docker/Dockerfile
	$(BIN)/yamllint --strict docker

lock:  ## Renew requirements.lock and the benchmark's (needs uv)
	uv pip compile --universal --python-version 3.11 --generate-hashes --no-annotate --upgrade --group dev pyproject.toml -o requirements.lock
	uv pip compile --universal --python-version 3.11 --generate-hashes --no-annotate --upgrade --group bench \
		--constraint requirements.lock --no-emit-package cython --no-emit-package numpy --no-emit-package setuptools \
		-o tests/benchmark/requirements.lock

openapi: $(INSTALLED)  ## Write openapi/airmatrix.json anew
	$(BIN)/airmatrix openapi --out openapi/airmatrix.json
