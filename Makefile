# `make` alone says what there is. Needs git, make and Python 3.11 to 3.13 with venv, or a sourced ROS 2 Jazzy.
PYTHON ?= python3
VENV := .venv/bin/python
STAGES ?=

.DEFAULT_GOAL := help
.PHONY: help venv demo test test-all rest bench lint docs clean
.NOTPARALLEL:

help:
	@echo 'track_fusion: track-to-track fusion for ROS 2 Jazzy'
	@echo
	@echo '  make demo    run the published scenario over ROS 2: a table, a bag and a picture in out/demo/'
	@echo '  make test    linters and the suite, on the oldest NumPy and SciPy, too: minutes'
	@echo '               (some stages only: make test STAGES="lint suite")'
	@echo '  make test-all    that, then what is slow or needs more: the rest with the oldest versions, colcon,'
	@echo '               a bare environment'
	@echo '  make lint    the linters alone: ruff and mypy'
	@echo '  make bench   measure speed and print ratios'
	@echo '  make docs    write the pages and parameter files that are made from the code'
	@echo '  make venv    only make or update .venv, which the others start with'
	@echo '  make clean   remove environments, builds and results'
	@echo
	@echo 'The Python used is $(PYTHON); choose another with, say, make demo PYTHON=python3.12.'
	@echo 'In a shell with ROS 2 Jazzy sourced, that ROS is used; elsewhere ROS comes as Python wheels.'
	@echo 'On a robot: colcon build, then ros2 launch track_fusion demo.launch.py.'

venv:
	@$(PYTHON) tools/make_venv.py

demo: venv
	@.venv/bin/track-fusion demo

test: venv
	@$(VENV) -m tools.run_tests $(STAGES)

test-all: test rest

rest: venv
	@$(VENV) -m tools.run_tests --rest

lint: venv
	@$(VENV) -m tools.run_tests lint

docs: venv
	@$(VENV) -m tools.docs

bench: venv
	@$(VENV) -m benchmark

clean:
	rm -rf .venv .venv-floor .venv-bare build install log out *.egg-info
	rm -rf .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
