# Targets are listed by `make help`. The environment in .venv follows the pins of requirements*.txt.
PYTHON ?= python3
# Which build of PyTorch: cpu (2.7 GB in all), where no NVIDIA driver is loaded; default, the package index's own
# (for CUDA: 6.3 GB); or auto, cu128 and so on, as uv has them.
TORCH ?= $(if $(wildcard /proc/driver/nvidia/version),default,cpu)
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PIP := $(BIN)/pip install --quiet --disable-pip-version-check
# Its build, and so its hash, depends on TORCH: installed first, without a hash, with the CUDA libraries that it needs.
PYTORCH := $(firstword $(shell grep '^torch==' requirements.txt))
PINS := requirements.txt requirements-dev.txt pyproject.toml

MAKEFLAGS += --no-print-directory
# Bytecode is kept whatever the shell says; else each worker and each command of a test compiles everything anew.
unexport PYTHONDONTWRITEBYTECODE
.DEFAULT_GOAL := help
.PHONY: setup catch test check docs wheel results format help
.DELETE_ON_ERROR:

setup: $(READY) ## make .venv from the pinned versions (once; again when they change)

$(READY): $(PINS)
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14) and "Python 3.11 to 3.13 is needed: make setup PYTHON=python3.12")'
	@echo "Setting up $(VENV) from the pinned versions, PyTorch: $(TORCH) (one to three minutes) ..."
	@$(PYTHON) -m venv --clear $(VENV)
ifneq ($(TORCH),default)
	@sed -n '/^uv==/,/[^\\]$$/p' requirements-dev.txt >$(VENV)/uv.txt
	@$(PIP) --require-hashes --no-deps -r $(VENV)/uv.txt
	@UV_HTTP_RETRIES=0 $(BIN)/uv pip install --quiet --python $(BIN)/python --torch-backend=$(TORCH) \
		$(PYTORCH) 2>$(VENV)/torch.log \
		|| echo "No such build of PyTorch can be reached (see $(VENV)/torch.log): pip takes the one that it finds."
endif
	@$(PIP) $(PYTORCH)
	@$(PIP) --require-hashes --no-deps -r requirements.txt -r requirements-dev.txt
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --editable .
	@touch $@

catch: $(READY) ## catch a thrown object with the shipped policy
	@$(BIN)/pixel2catch catch

test: $(READY) ## run the tests
	@$(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder

check: $(READY) ## formatting, lint, types, import rules, spelling, tables of results
	@$(BIN)/ruff format --check --quiet .
	@$(BIN)/ruff check --quiet .
	@$(BIN)/basedpyright --pythonpath $(BIN)/python
	@$(BIN)/lint-imports --no-logo
	@$(BIN)/codespell
	@$(BIN)/python companions/results/results.py --check

docs: $(READY) ## build the site of docs/ into site/; warnings are errors
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --quiet --strict

wheel: $(READY) ## build the wheel, and try it away from here
	@.ci/try_wheel

results: $(READY) ## compute missing studies of the documents (all, or STUDIES="NAMES"), and write their tables
	@$(BIN)/python companions/results/results.py $(STUDIES)

format: $(READY) ## format the code and mend what ruff can mend
	@$(BIN)/ruff format --quiet .
	@$(BIN)/ruff check --fix --quiet .

help: ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /\1 - /p' $(MAKEFILE_LIST)
