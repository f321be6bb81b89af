# make demo and make test set up what is missing, also on a bare Debian or Ubuntu; a second call is quick.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed # its time says for which pyproject.toml the environment was made
INSTALLED_DEV := $(VENV)/.installed-dev # likewise with what tests, linter and type checker need
DEMO := outputs/demo

IN_RANGE := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))

# The first Python in the range that the libraries have wheels for; a plain python3 may be a version manager's shim.
PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11; do \
	"$$python" -c '$(IN_RANGE)' 2>/dev/null && \
	command -v "$$python" && break; done)

.PHONY: help
help: ## this list
	@sed -nE 's/^([a-z-]+):.*## (.*)/\1\t\2/p' $(MAKEFILE_LIST) | while IFS=$$'\t' read -r target says; do \
		printf '%-18s%s\n' "$$target" "$$says"; done

.PHONY: demo
demo: $(INSTALLED) ## map a real desk, leave the record in outputs/demo
	@$(BIN)/python -m framework hydra.run.dir=$(DEMO)
	@page="$$($(BIN)/python -m framework report $(DEMO))"; echo "report: $$page"

PYTEST = $(BIN)/python -m pytest --numprocesses logical --maxprocesses 4 --dist loadfile --no-loadscope-reorder --quiet

.PHONY: check
check: $(INSTALLED_DEV) ## run linters, type checks and unit tests
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/codespell
	$(BIN)/mypy
	$(BIN)/python -m framework compile --all
	$(PYTEST) -m unit

.PHONY: test
test: check ## make check, then the integration tests
	$(PYTEST) -m "integration and not acceptance"

.PHONY: acceptance
acceptance: $(INSTALLED_DEV) ## measure missing or outdated acceptance lines; LINE=name measures one
	$(BIN)/python -m tests.acceptance $(LINE)

.PHONY: docs
docs: $(INSTALLED_DEV) ## build the pages of docs/ into outputs/docs
	@$(BIN)/python -m sphinx -W --keep-going -n -q -d outputs/docs/.doctrees docs outputs/docs
	@echo "outputs/docs/index.html"

.PHONY: install
install: $(INSTALLED_DEV) ## only set up, for developers
	@$(BIN)/python -m framework compile --all

.PHONY: format
format: $(INSTALLED_DEV) ## format the code and mend what the linter can
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

.PHONY: clean
clean: ## remove the environment and all caches; outputs stay
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find framework plugins tests docs -name __pycache__ -type d -prune -exec rm -rf {} +

# The first time pip shows its downloads, which are large; later, after a change of pyproject.toml, only what is wrong.
# PIP_USE_PEP517 spares the older pips a warning about one of Hydra's libraries.
PIP_INSTALL = PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_USE_PEP517=1 $(BIN)/python -m pip install \
	$(if $(wildcard $@),--quiet)

# torch by its exact version first: pip then takes a local CPU wheel where the machine offers one.
$(INSTALLED): pyproject.toml
	@$(MAKE) --no-print-directory system-libraries
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || "$(or $(PYTHON),python3)" -m venv $(VENV)
	@echo "installing the libraries into $(VENV)"
	@$(PIP_INSTALL) 'pip>=25.1' # reads dependency groups
	@$(PIP_INSTALL) 'torch==2.13.0'
	@$(PIP_INSTALL) --editable .
	@touch $(INSTALLED)

$(INSTALLED_DEV): $(INSTALLED)
	@$(MAKE) --no-print-directory browser
	@echo "installing what the tests need"
	@$(PIP_INSTALL) --group dev --editable '.[all]'
	@touch $(INSTALLED_DEV)

# What is missing of: Python with venv, git (for the commit in the run records), Open3D's shared libraries.
define MISSING
PATH="$$PATH:/usr/sbin:/sbin"; libraries="$$(ldconfig -p 2>/dev/null || true)"; missing=""; \
test -n "$(PYTHON)" || missing="$$missing python3"; \
test -n "$(PYTHON)" && "$(PYTHON)" -c 'import ensurepip, venv' 2>/dev/null || missing="$$missing python3-venv"; \
command -v git >/dev/null || missing="$$missing git"; \
grep -q 'libusb-1\.0\.so\.0' <<<"$$libraries" || missing="$$missing libusb-1.0-0"; \
grep -q 'libGL\.so\.1' <<<"$$libraries" || missing="$$missing libgl1"; \
grep -q 'libEGL\.so\.1' <<<"$$libraries" || missing="$$missing libegl1"; \
grep -q 'libgomp\.so\.1' <<<"$$libraries" || missing="$$missing libgomp1"
endef

# Chromium, in which tests open the pages that are written; without it they are skipped. Ubuntu's package is a stub. What
# drives it, playwright's node, needs libatomic1.
.PHONY: browser
browser:
	@PATH="$$PATH:/usr/sbin:/sbin"; \
	if ! { command -v chromium && ldconfig -p | grep 'libatomic\.so\.1'; } >/dev/null 2>&1 \
			&& command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
		echo "installing chromium, for tests"; \
		{ apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends \
			chromium fonts-dejavu-core libatomic1; } >/dev/null || echo "without chromium some tests are skipped"; \
	fi

.PHONY: system-libraries
system-libraries: ## install the system packages that are missing, with apt
	@$(MISSING); \
	if test -z "$$missing"; then exit 0; fi; \
	apt="apt-get update && apt-get install --yes --no-install-recommends$$missing"; \
	if ! command -v apt-get >/dev/null; then \
		echo "missing:$$missing; install what your system calls them" >&2; exit 1; \
	elif test "$$(id -u)" = 0; then \
		echo "installing$$missing"; DEBIAN_FRONTEND=noninteractive bash -c "$$apt" >/dev/null; \
	elif sudo -n true 2>/dev/null || { test -t 0 && command -v sudo >/dev/null; }; then \
		echo "installing$$missing"; sudo DEBIAN_FRONTEND=noninteractive bash -c "$$apt" >/dev/null; \
	else \
		echo "as root: $$apt" >&2; exit 1; \
	fi
	@"$(or $(PYTHON),python3)" -c '$(IN_RANGE)' || { echo "Python 3.11 to 3.13 is needed" >&2; exit 1; }
