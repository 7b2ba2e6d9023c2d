.DEFAULT_GOAL := help
.PHONY: help setup play demo test test-slow check format bench bench-diagnose tables docs docs-serve release-check demo-quick clean-demo

# Commands start twice as fast when Python may keep what it has compiled.
unexport PYTHONDONTWRITEBYTECODE

VENV := .venv/bin
JOBS ?= 2
ARGS ?=

help: ## show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-14s %s\n", $$1, $$2}' Makefile

setup: ## create .venv with pinned packages (automatic in every other target)
	@sh scripts/setup_venv.sh

demo: setup ## demonstrations, imitation, DPPO, evaluation, report: outputs/demo/report.html
	@$(VENV)/vtrefine-demo $(ARGS)

play: setup ## a trained policy in the simulation, live in a browser
	@$(VENV)/vtrefine-play $(ARGS)

demo-quick: setup ## the same with tiny numbers, in minutes, to see that everything works
	@$(VENV)/vtrefine-demo --quick $(ARGS)

test: setup ## the test-suite, without slow, gpu and hardware tests
	@OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(VENV)/python -m pytest -q -n $(JOBS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-slow: setup ## the tests marked slow
	@$(VENV)/python -m pytest -m slow $(ARGS)

check: setup ## format, lint, types, structure
	@$(VENV)/ty check --quiet
	@$(VENV)/python -m pytest -q tests/test_structure.py  # runs ruff, too

format: setup ## rewrite the sources in the project's format
	@$(VENV)/ruff check --quiet --fix-only .
	@$(VENV)/ruff format --quiet .

bench: setup ## speed, as ratios measured in one run
	@$(VENV)/vtrefine-bench $(ARGS)

bench-diagnose: setup ## vtrefine-diagnose on recordings with known causes: the table and its bars
	@$(VENV)/python scripts/bench_diagnose.py $(ARGS)

docs: setup ## the documentation as a site, links checked strictly: outputs/site/index.html
	@NO_MKDOCS_2_WARNING=1 $(VENV)/mkdocs build --strict

docs-serve: setup ## the same, served while you write
	@NO_MKDOCS_2_WARNING=1 $(VENV)/mkdocs serve

release-check: setup ## build the wheel and try it, and the README's lines, in an empty environment
	@$(VENV)/python scripts/release_check.py $(ARGS)

tables: setup ## the tables of README and docs from results/*.json; scripts/collect_results.py --help fills these
	@$(VENV)/python scripts/make_tables.py

clean-demo: ## remove the demo's outputs, so that the next one starts afresh
	@rm -rf outputs/demo
