PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# As the command line does by itself: matrices here have tens of rows, and threads wait longer for each other than they compute.
export OPENBLAS_NUM_THREADS ?= 1
# As Python does by itself: a machine that forbids it has each process compile the whole package anew.
export PYTHONDONTWRITEBYTECODE :=
READY := $(VENV)/.ready

.PHONY: run demo test viewers browser soak-panel-triggers panel-load bench faults faults-pairs faults-mutants soak-live-changes soak-laws soak-daemon soak-flood soak-connections soak-swaps soak-recordings soak-forged soak-chain soak-delay soak-robust soak-aborts soak-response soak-closed-loop soak-retune soak-backends soak-day check install uninstall test-systemd rig clean soak-identification soak-parts soak-truths soak-afm soak-verify flagship soak-conformance mutants planted strace soak-syscalls

# The paper's closed loop for ten seconds, installed first where it is not.
run: $(READY)
	$(BIN)/rtloop run deploy/paper.toml --duration 10

# The loop on a simulated board with its panel in the browser, until Ctrl-C; prints the address.
demo: $(READY)
	deploy/demo $(abspath $(BIN)/rtloop)

# Large arrays come and go by the thousand: to ask the system for each one's memory costs a quarter of some tests.
test: export MALLOC_MMAP_THRESHOLD_ := 268435456
test: export MALLOC_TRIM_THRESHOLD_ := 536870912
test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright --pythonpath $(BIN)/python
	$(BIN)/lint-imports
	$(BIN)/python -m rtloop.cli.warm
	$(BIN)/pytest -n 3 --dist loadfile --no-loadscope-reorder

# Foxglove's own client and decoders, with which `make test` reads what viewers get: needs node and npm.
viewers:
	npm install --prefix build/node --no-save --no-package-lock --no-audit --no-fund \
		@foxglove/ws-protocol @foxglove/rosmsg @foxglove/rosmsg2-serialization ws

# What the tests of the panel's page need: Debian's Chromium (as root), Playwright, and axe, which judges accessibility.
browser: $(READY)
	command -v chromium >/dev/null || apt-get install --yes chromium
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[browser]'
	npm install --prefix $(VENV)/lib --no-save --silent axe-core@4 || echo "axe-core could not be installed: its test will be skipped"

# What traces system calls, from Debian's packages (as root): tests that need it are skipped without.
strace:
	command -v strace >/dev/null || { apt-get update && apt-get install --yes strace; }

# Each system call of recorder, recover, cut, quota, note of the hardware, parking and a service's start and stop fails,
# or is the last before SIGKILL: an hour and a half; `make test` tries 200 of them.
soak-syscalls: $(READY) strace
	$(BIN)/python -m tests.syscalls --mutants
	$(BIN)/python -m tests.syscalls

# Some thirty faults on real processes, and a table of what came of them: about four minutes, as root for the full disk.
faults: $(READY)
	$(BIN)/python -m tests.faults

# Mistakes planted one at a time, each of which must make a row of that table fail: about five minutes.
faults-mutants: $(READY)
	$(BIN)/python -m tests.faults.mutants

# Mistakes that a competent programmer could make, planted one by one in a copy of the tree (tests/planted): each turns
# its tests red. A minute each where kernels are compiled anew; `WORDS="ramp pid"` for some of them.
planted: $(READY)
	$(BIN)/python -m tests.planted $(WORDS)

# Two of them at once, a hundred times at random: a quarter of an hour.
faults-pairs: $(READY)
	$(BIN)/python -m tests.faults.pairs

# A law changed at random for 10^8 ticks, with canaries around its records: about ten minutes, 1 GB in the temporary folder.
soak-live-changes: $(READY)
	$(BIN)/python -m tests.soak.live_changes

# A thousand live changes of every shipped controller, for each of SEEDS (such as "1 2 3"): a quarter of an hour each.
soak-laws: $(READY)
	$(BIN)/python -m tests.soak.laws $(SEEDS)

# The control API under eight clients beside a paced run; swaps through it; the daemon on a board for an hour.
soak-flood: $(READY)
	$(BIN)/python -m tests.soak.api_flood

# Two thousand silent and slow clients and every hostile request, while an operator stops and starts: a minute.
soak-connections: $(READY)
	$(BIN)/python -m tests.soak.connections

# Ten thousand steps of one tick's width, each to be found by the panel's trigger at its tick: ten minutes.
soak-panel-triggers: $(READY)
	$(BIN)/python -m tests.soak.panel_triggers

# What the panel costs: lateness of a paced run with four clients and with none, in pairs, CPU, bytes: as root, some minutes.
panel-load: $(READY)
	$(BIN)/python -m tests.soak.panel_load

soak-swaps: $(READY)
	$(BIN)/python -m tests.soak.swaps

soak-daemon: $(READY)
	$(BIN)/python -m tests.soak.daemon

# Mistakes planted at random in the rooms that must not fail, and whether the tests see them; results stay in build/mutants,
# where it goes on when it is called again: about an hour for 400; `FLAGS="--rooms law engine"`, `FLAGS=--again` for survivors.
mutants: $(VENV)/.mutants
	$(BIN)/python -m tests.mutants --mutants $(or $(MUTANTS),400) --seed $(or $(SEED),1) --jobs $(or $(JOBS),2) $(FLAGS)

# Every benchmark, about half an hour, as root for real-time scheduling; figures are kept in .benchmarks/, and
# `.venv/bin/python -m tests.benchmarks --page docs/benchmarks.md` puts the newest into that page.
bench: $(VENV)/.bench
	$(BIN)/python -m tests.benchmarks

# Killed runs, damaged files, other processors, an hour at 10 kHz: about half an hour, 2 GB in the temporary folder.
soak-recordings: $(READY)
	$(BIN)/python -m tests.soak.recordings

# Ten thousand forged recordings through every command: half an hour to an hour.
soak-forged: $(READY)
	$(BIN)/python -m tests.soak.forged

# Some nine thousand variants of the files of the public MCAP conformance suite through `info` and `import`: about
# half an hour; `MOST=1` for two hundred of them.
soak-conformance: $(READY)
	$(BIN)/python -m tests.soak.conformance $(MOST)

# Identification on 50 rigs drawn at random, three times: about ten minutes.
soak-identification: $(READY)
	$(BIN)/python -m tests.soak.identification

# Hysteresis from parts of loops on 50 rigs drawn at random, memory unknown beside memory known: a minute or two
# of one core; `FIRST=100` for other rigs.
soak-parts: $(READY)
	$(BIN)/python -m tests.soak.parts --draws $(or $(DRAWS),50) --first $(or $(FIRST),0)

# Bouc-Wen and Preisach actuators, six sets of recordings each: the error that is reported beside the true one: a minute.
soak-truths: $(READY)
	$(BIN)/python -m tests.soak.truths

# Hysteresis of commercial AFMs' scanners, whose recordings are fetched from the package registry: two minutes of one core.
soak-afm: $(READY)
	$(BIN)/python -m tests.soak.afm

# Recordings, identification, synthesis and a run on forty rigs drawn at random: about ten minutes.
soak-chain: $(READY)
	$(BIN)/python -m tests.soak.chain

# Ten rigs behind a lag and a delay, promise beside run, and how often ± covers the truth in twice DRAWS (50)
# identifications: about a quarter of an hour of one core.
soak-delay: $(READY)
	$(BIN)/python -m tests.soak.delay --draws $(or $(DRAWS),50)

# The same by `design auto --robust`, promise beside run, on DRAWS rigs (20): a minute or two of one core each.
soak-robust: $(READY)
	$(BIN)/python -m tests.soak.robust_chain --draws $(or $(DRAWS),20)

# What `design verify` predicts beside what 200 recorded runs show: a quarter of an hour; `DRAWS=20` for fewer.
soak-verify: $(READY)
	$(BIN)/python -m tests.soak.believed --draws $(or $(DRAWS),200)

# The paper's loop and rtloop's own on one rig, every figure beside its goal, with pictures, in recordings/flagship: about ten
# minutes; `DRAWS=0` for four, `FLAGS=--rigs` for other stages too.
flagship: $(READY)
	$(BIN)/python -m tests.soak.flagship --draws $(or $(DRAWS),500) $(FLAGS)

# A service measures its own loop on rigs of known transfer function: about six minutes.
soak-response: $(READY)
	$(BIN)/python -m tests.soak.response

# Dynamics from DRAWS (50) closed loops with coloured noise, and from five on the simulated rig: about ten minutes.
soak-closed-loop: $(READY)
	$(BIN)/python -m tests.soak.closed_loop --draws $(or $(DRAWS),50)

# A service whose resonance or gain has moved measures both, makes its taps anew, and steps and scans: fifteen minutes.
soak-retune: $(READY)
	$(BIN)/python -m tests.soak.retune
	$(BIN)/python -m tests.soak.retune_gain

# A simulated day with 20 events, recorded around them: bytes, replay, `info`; a quota and, as root, a disk that fills:
# a quarter of an hour to half an hour, 1 GB in the temporary folder; `HOURS=1` for less.
soak-day: $(READY)
	$(BIN)/python -m tests.soak.day --hours $(or $(HOURS),24)

# One configuration on every backend that needs no hardware, side by side: two minutes.
soak-backends: $(READY)
	$(BIN)/python -m tests.soak.backends

# Ctrl-C at twenty random moments of experiments, in virtual and in real time: about ten minutes.
soak-aborts: $(READY)
	$(BIN)/python -m tests.soak.aborts

check: $(READY)
	$(BIN)/rtloop check deploy/paper.toml

$(READY): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[test]'
	$(BIN)/python -m rtloop.cli.warm
	touch $@

$(VENV)/.bench: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[bench]'
	touch $@

$(VENV)/.mutants: $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt --editable '.[mutants]'
	touch $@

# As root; PREFIX, DESTDIR and PIP_ARGS (such as "--no-index --find-links FOLDER") are explained in deploy/install.
install uninstall:
	PYTHON='$(PYTHON)' PREFIX='$(PREFIX)' DESTDIR='$(DESTDIR)' PIP_ARGS='$(PIP_ARGS)' deploy/install $@

# As root, with debootstrap and systemd-container: the installed service under a real systemd, in a Debian container.
test-systemd: $(READY)
	PYTHON='$(abspath $(BIN)/python)' tests/systemd/run

# As root, with debootstrap and qemu-system-x86: the kernel's comedi board, SocketCAN and systemd on a PREEMPT_RT kernel, in
# an emulated machine: a quarter of an hour to half an hour.
rig: $(READY)
	PYTHON='$(abspath $(BIN)/python)' tests/rig/run

clean:
	rm -rf $(VENV) build dist *.egg-info
