# `make demo` and `make test` are all that a fresh machine with Python 3.11, 3.12 or 3.13 needs.

VENV := .venv
PYTHON := $(VENV)/bin/python
PIP_INSTALL := $(PYTHON) -m pip install -qq --disable-pip-version-check -c constraints.txt
# Two threads on two busy cores can be many times slower than one.
export OMP_NUM_THREADS ?= 1

.DEFAULT_GOAL := help
.PHONY: help install demo test test-slow docs figures clean

help:  ## say what there is
	@sed -n 's/^\([a-z-]*\):.*  ## /  make \1\t/p' Makefile | expand -t 20

install: $(VENV)/install.stamp  ## make .venv and install torchpose into it; quick when nothing changed

demo: install  ## install, then recover the poses from a recording that the package makes itself
	$(PYTHON) infer.py output=runs/demo
	@echo "The results are in $(CURDIR)/runs/demo: open report.html."

test: $(VENV)/test.stamp  ## install, then lint, types and the fast tests
	$(VENV)/bin/ruff check .
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/mypy
	$(VENV)/bin/pytest -q -n 2

test-slow: $(VENV)/test.stamp  ## install, then the tests that take longer
	$(VENV)/bin/pytest -q -m slow

# Strict counts warnings that it prints, so nothing may be --quiet; the variable hides an advertisement of Material's successor.
docs: $(VENV)/docs.stamp  ## install, then build the documentation into site/, strictly and offline
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict
	@echo "The documentation is in $(CURDIR)/site/index.html."

figures: install  ## install, then draw the thesis's figures from recordings that the package makes itself
	$(PYTHON) -m benchmarks.figures
	$(PYTHON) -m benchmarks.angle_figures
	$(PYTHON) infer.py output=runs/demo
	$(PYTHON) -m benchmarks.moving_figure runs/demo/overlay.mp4 docs/figures/demo.webp

clean:  ## remove .venv and everything that installing, testing and running leave behind
	rm -rf $(VENV) runs site dist build .pytest_cache .mypy_cache .ruff_cache .hypothesis *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

# The stamps are newer than what they were made from, so make has nothing to do the second time.
$(PYTHON):
	@python=""; for name in python3.11 python3 python3.12 python3.13; do \
	  if $$name -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null; \
	  then python=$$name; break; fi; done; \
	if [ -z "$$python" ]; then \
	  echo "torchpose needs Python 3.11, 3.12 or 3.13, and found none; install one, so that python3 starts it" >&2; \
	  exit 1; fi; \
	"$$python" -m venv $(VENV)

$(VENV)/install.stamp: pyproject.toml constraints.txt | $(PYTHON)
	$(PIP_INSTALL) -e .
	@touch $@

$(VENV)/test.stamp: $(VENV)/install.stamp
	$(PIP_INSTALL) -e '.[test]'
	@touch $@

$(VENV)/docs.stamp: $(VENV)/install.stamp
	$(PIP_INSTALL) -e '.[docs]'
	@touch $@
