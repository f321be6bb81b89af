# `make demo` and `make test` install missing dependencies, including system packages on Debian and Ubuntu. Later calls skip
# the installation.

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help

VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed # stamp file; the environment is outdated if pyproject.toml is newer
INSTALLED_DEV := $(VENV)/.installed-dev # stamp file of the development tools
DEMO := outputs/demo

IN_RANGE := import sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))

# First Python in the supported range. Each candidate is run, because python3 may be a shim of a version manager.
PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11; do \
	"$$python" -c '$(IN_RANGE)' 2>/dev/null && \
	command -v "$$python" && break; done)

.PHONY: help
help: ## list the targets
	@sed -nE 's/^([a-z-]+):.*## (.*)/\1\t\2/p' $(MAKEFILE_LIST) | while IFS=$$'\t' read -r target description; do \
		printf '%-18s%s\n' "$$target" "$$description"; done

.PHONY: demo
demo: $(INSTALLED) ## map the desk sequence into outputs/demo and write its report
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
test: check ## run make check and the integration tests
	$(PYTEST) -m "integration and not acceptance"

.PHONY: acceptance
acceptance: $(INSTALLED_DEV) ## run the missing and outdated acceptance measurements; MEASUREMENT=NAME runs one
	$(BIN)/python -m tests.acceptance $(MEASUREMENT)

.PHONY: endurance
endurance: $(INSTALLED_DEV) ## map 10,000 frames and fail if memory, time, instances or errors grow
	$(BIN)/python -m tests.endurance

.PHONY: docs
docs: $(INSTALLED_DEV) ## build the documentation into outputs/docs
	@$(BIN)/python -m sphinx -W --keep-going -n -q -d outputs/docs/.doctrees docs outputs/docs
	@echo "outputs/docs/index.html"

.PHONY: install
install: $(INSTALLED_DEV) ## create the environment with all development tools
	@$(BIN)/python -m framework compile --all

.PHONY: format
format: $(INSTALLED_DEV) ## format the code and auto-fix lint errors
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

# Versions of all dependencies for pip --constraint. A local version such as 2.13.0+cpu is written as 2.13.0.
PYTHONS ?= python3.11 python3.12 python3.13
define CONSTRAINTS
import json, sys
found = {one["metadata"]["name"].lower(): one["metadata"]["version"].partition("+")[0] for one in json.load(sys.stdin)["install"]}
print("# Versions of all dependencies on Linux with the extra all and the group dev, written by make lock")
print("\n".join(f"{name}=={version}" for name, version in sorted(found.items()) if name != "instancemap"))
endef
export CONSTRAINTS

.PHONY: lock
lock: ## write constraints/pythonX.Y.txt; PYTHONS="..." selects the interpreters
	@mkdir -p constraints
	@for python in $(PYTHONS); do \
		folder="$$(mktemp -d)"; trap 'rm -rf "$$folder"' EXIT; \
		"$$python" -m venv "$$folder"; "$$folder/bin/pip" install --quiet 'pip>=25.1'; \
		name="$$("$$python" -c 'import sys; print("python{}.{}.txt".format(*sys.version_info))')"; \
		"$$folder/bin/pip" install --quiet --dry-run --ignore-installed --report "$$folder/report" \
			'$(TORCH)' --group dev '.[all]'; \
		"$$folder/bin/python" -c "$$CONSTRAINTS" <"$$folder/report" >"$$folder/constraints"; \
		mv "$$folder/constraints" "constraints/$$name"; rm -rf "$$folder"; echo "constraints/$$name"; \
	done

.PHONY: clean
clean: ## remove the environment and all caches, but not outputs/
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis
	find framework plugins tests docs -name __pycache__ -type d -prune -exec rm -rf {} +

# The first installation shows the progress of its large downloads; updates after a change of pyproject.toml are quiet.
# PIP_USE_PEP517 prevents a warning of older pip versions about a dependency of Hydra. PIP_NO_COMPILE saves minutes, because
# Python compiles only the imported modules, when they are first imported.
PIP_INSTALL = PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_USE_PEP517=1 PIP_NO_COMPILE=1 $(BIN)/python -m pip install \
	$(if $(wildcard $@),--quiet)

# torch is installed first with its exact version, so that pip uses a local CPU wheel if the machine has one.
TORCH := torch==2.13.0
$(INSTALLED): pyproject.toml
	@$(MAKE) --no-print-directory system-libraries
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || "$(or $(PYTHON),python3)" -m venv $(VENV)
	@echo "installing the Python dependencies into $(VENV)"
	@$(PIP_INSTALL) 'pip>=25.1' # supports dependency groups
	@$(PIP_INSTALL) '$(TORCH)'
	@$(PIP_INSTALL) --editable .
	@touch $(INSTALLED)

$(INSTALLED_DEV): $(INSTALLED)
	@$(MAKE) --no-print-directory browser latex
	@echo "installing the development tools into $(VENV)"
	@$(PIP_INSTALL) --group dev --editable '.[all]'
	@touch $(INSTALLED_DEV)

# Missing system packages: Python with venv, git (for the commit in run directories), shared libraries of Open3D.
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

# Chromium for browser tests, which are skipped without it. Ubuntu's chromium package only installs the snap. The Node.js of
# Playwright requires libatomic1.
.PHONY: browser
browser:
	@PATH="$$PATH:/usr/sbin:/sbin"; \
	if ! { command -v chromium && ldconfig -p | grep 'libatomic\.so\.1'; } >/dev/null 2>&1 \
			&& command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
		echo "installing chromium for the browser tests"; \
		{ apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends \
			chromium fonts-dejavu-core libatomic1; } >/dev/null || echo "chromium: installation failed; browser tests are skipped"; \
	fi

# LaTeX for the tests of tables, which are skipped without it.
.PHONY: latex
latex:
	@if ! command -v pdflatex >/dev/null && command -v apt-get >/dev/null && test "$$(id -u)" = 0; then \
		echo "installing LaTeX for the tests of tables"; \
		{ apt-get update && DEBIAN_FRONTEND=noninteractive apt-get install --yes --no-install-recommends \
			texlive-latex-base texlive-latex-recommended; } >/dev/null || \
			echo "LaTeX: installation failed; its tests are skipped"; \
	fi

.PHONY: system-libraries
system-libraries: ## install missing system packages with apt
	@$(MISSING); \
	if test -z "$$missing"; then exit 0; fi; \
	apt="apt-get update && apt-get install --yes --no-install-recommends$$missing"; \
	if ! command -v apt-get >/dev/null; then \
		echo "system packages: expected$$missing (Debian names), got none of them; install their equivalents" >&2; exit 1; \
	elif test "$$(id -u)" = 0; then \
		echo "installing$$missing"; DEBIAN_FRONTEND=noninteractive bash -c "$$apt" >/dev/null; \
	elif sudo -n true 2>/dev/null || { test -t 0 && command -v sudo >/dev/null; }; then \
		echo "installing$$missing"; sudo DEBIAN_FRONTEND=noninteractive bash -c "$$apt" >/dev/null; \
	else \
		echo "system packages: expected$$missing, got none of them; run as root: $$apt" >&2; exit 1; \
	fi
	@"$(or $(PYTHON),python3)" -c '$(IN_RANGE)' || { echo "python: expected Python 3.11 to 3.13, got none; install one of these versions" >&2; exit 1; }
