PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
QUICK := tests/kernel tests/hil tests/engine/test_clock.py tests/engine/test_ring.py tests/laws/test_shipped.py tests/service/test_desk.py \
	tests/service/test_requests.py tests/panel/feed tests/panel/spectrum tests/interchange/test_units.py tests/recording/test_verdict.py \
	tests/test_config.py tests/test_kernels.py tests/test_opened_files.py tests/test_prepare.py tests/test_tree.py
# Tests of `make test` and `make test-system` together.
SHORT := not benchmark and not soak
# As the command line does by itself: matrices here have tens of rows, and threads wait longer for each other than they compute.
export OPENBLAS_NUM_THREADS ?= 1
# As Python does by itself: a machine that forbids it has each process compile the whole package anew.
export PYTHONDONTWRITEBYTECODE :=
# READY: what running, looking, designing and the panel need. TESTED: what the tests need besides.
READY := $(VENV)/.ready
TESTED := $(VENV)/.tested

.PHONY: help run demo campaign quick test test-system tools bench faults soak mutants rig test-systemd test-deb dist deb site news install uninstall clean

help: ## print this list
	@sed -nE 's/^([a-z-]+)( [a-z]+)?:.*## (.*)/\1\2|\3/p' $(MAKEFILE_LIST) | awk -F'|' '{printf "make %-16s %s\n", $$1, $$2}'

run: $(READY) ## install into .venv, then the paper's closed loop for ten seconds
	$(BIN)/rtloop run deploy/paper.toml --duration 10

demo: $(READY) ## the loop on a simulated board with its panel in the browser, until Ctrl-C
	$(BIN)/rtloop demo $(if $(PORT),--port $(PORT))

# Workers need Parquet and, with a scheduler, Dask: the extra `campaign`, which the tests install as well.
campaign: $(TESTED) ## 1,000 rigs each of the paper's controller and of robust.toml, compared on one page
	-$(BIN)/rtloop campaign run deploy/campaign.toml
	-$(BIN)/rtloop campaign run deploy/campaign.toml --config deploy/robust.toml
	$(BIN)/rtloop campaign compare campaigns/campaign-paper campaigns/campaign-robust --page campaigns/comparison.html

quick: $(TESTED) ## checks of names, types of imports, and the tests that finish in one minute
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/pytest -n 2 --dist loadfile $(QUICK)

# Collecting once beforehand, beside pyright, writes the compiled tests, which the two workers would each do for themselves.
# Large arrays come and go by the thousand: asking the system for the memory of each costs a quarter of some tests' time.
test: export MALLOC_MMAP_THRESHOLD_ := 268435456
test: export MALLOC_TRIM_THRESHOLD_ := 536870912
test: $(TESTED) ## all checks, and the tests that start no service, worker or browser
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	mkdir -p build
	$(BIN)/pyright --pythonpath $(BIN)/python > build/types 2>&1 & types=$$!; \
		$(BIN)/lint-imports && $(BIN)/python -m rtloop.cli.warm && $(BIN)/pytest --collect-only > build/collected && \
		$(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder -m '$(SHORT) and not system'; tests=$$?; \
		wait $$types; types=$$?; cat build/types; exit $$((tests + types))

# They keep real time and wait for processes, so that a third worker has work while two wait.
test-system: $(TESTED) ## the tests of real processes: services, boards, nodes, workers, builds, and the panel in a browser
	$(BIN)/python -m rtloop.cli.warm
	$(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder -m '$(SHORT) and system'

tools: $(TESTED) ## what some tests need besides (as root): strace, Chromium, Playwright, axe, Foxglove's client, schemathesis, promtool
	command -v strace >/dev/null || { apt-get update && apt-get install --yes strace; } || echo "strace: tests that need it are skipped"
	command -v chromium >/dev/null || apt-get install --yes chromium || echo "Chromium: tests of the page are skipped"
	command -v promtool >/dev/null || apt-get install --yes --no-install-recommends prometheus || echo "promtool: its test is skipped"
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[browser,api-test]'
	npm install --prefix $(VENV)/lib --no-save --silent axe-core@4 || echo "axe-core: its test is skipped"
	npm install --prefix build/node --no-save --no-package-lock --no-audit --no-fund --silent \
		@foxglove/ws-protocol @foxglove/rosmsg @foxglove/rosmsg2-serialization ws || echo "Foxglove's client: its tests are skipped"

# Figures are kept in .benchmarks/; `.venv/bin/python -m tests.benchmarks --page docs/benchmarks.md` puts the newest into that page.
bench: $(VENV)/.bench ## every benchmark: half an hour, as root for real-time scheduling
	$(BIN)/python -m tests.benchmarks

faults: $(TESTED) ## 74 faults on real processes, and a table of the outcomes: ten minutes, as root for the full disk
	$(BIN)/python -m tests.faults $(FLAGS)

soak: $(TESTED) ## long tests: NAME=day FLAGS="--hours 1"; without NAME, a list of them
	$(BIN)/python -m tests.soak $(NAME) $(FLAGS)

# Results stay in build/mutants; the next call continues. FLAGS="--rooms laws engine", FLAGS=--again for survivors.
mutants: $(VENV)/.mutants ## random mistakes in the code, and whether the tests notice them: two hours for 400
	$(BIN)/python -m tests.mutants --mutants $(or $(MUTANTS),400) --seed $(or $(SEED),1) --jobs $(or $(JOBS),2) $(FLAGS)

rig: $(TESTED) ## comedi, SocketCAN and systemd on a PREEMPT_RT kernel in qemu, as root: half an hour
	PYTHON='$(abspath $(BIN)/python)' tests/rig/run

test-systemd: $(TESTED) ## the installed service under a real systemd in a container, as root
	PYTHON='$(abspath $(BIN)/python)' tests/systemd/run

test-deb: $(TESTED) ## the Debian package in the same container: installed, upgraded, purged, and what is left; as root
	PYTHON='$(abspath $(BIN)/python)' tests/systemd/run package

# The list of packages is that of an environment into which the wheel alone was installed. Times in the wheel are the commit's.
dist: export SOURCE_DATE_EPOCH := $(shell git log -1 --format=%ct 2>/dev/null || date +%s)
dist: $(VENV)/.release ## wheel and source archive in dist/, checked, and the list of their packages (SBOM, CycloneDX)
	rm -rf dist build/sbom rtloop.egg-info
	$(BIN)/python -m build --no-isolation
	$(BIN)/python -m twine check --strict dist/*
	$(PYTHON) -m venv build/sbom
	build/sbom/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt dist/*.whl
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --mc-type application --output-reproducible \
		--output-file dist/rtloop.cdx.json build/sbom/bin/python

deb: ## a Debian package of the service with all it needs, in dist/; PIP_ARGS as for install
	PYTHON='$(PYTHON)' PIP_ARGS='$(PIP_ARGS)' deploy/debian/build dist

news: $(VENV)/.release ## print the section of CHANGELOG.md that docs/news/ makes
	$(BIN)/towncrier build --draft --version $(or $(VERSION),next)

site: $(TESTED) ## the documentation in build/site: open build/site/index.html, no server needed
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict --quiet --config-file docs/site/mkdocs.yml

# PREFIX, DESTDIR and PIP_ARGS (such as "--no-index --find-links FOLDER") are explained in deploy/install.
install uninstall: ## the service on this machine, as root
	PYTHON='$(PYTHON)' PREFIX='$(PREFIX)' DESTDIR='$(DESTDIR)' PIP_ARGS='$(PIP_ARGS)' deploy/install $@

clean: ## remove .venv, build and dist
	rm -rf $(VENV) build dist *.egg-info

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[design]'
	$(BIN)/python -m rtloop.cli.warm
	touch $@

$(TESTED): $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test]'
	touch $@

$(VENV)/.bench: $(TESTED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[bench]'
	touch $@

$(VENV)/.release: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[release]'
	touch $@

$(VENV)/.mutants: $(TESTED)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[mutants]'
	touch $@
