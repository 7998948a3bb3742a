# Only python3 (3.11 or newer) and make are needed: every target makes the environment first.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
PIP := $(BIN)/python -m pip install -qq --disable-pip-version-check --no-input --constraint constraints.txt

DATA ?= ../shared/data

.PHONY: help env synthesis demo showcase readme pairs stages sensitivity conditions certainty without-rig alignment paper-network paper-tables outside fields trained-fields formats test test-long check format bench bench-job train notebooks docs drawings wheel fuzz mistakes kills transformations gradients

help:
	@echo "make demo       fuse the sample array into out/demo"
	@echo "make showcase   fuse real images from DATA=$(DATA) into out/showcase"
	@echo "make readme     run both and put what they print into docs/reports/demo.md and real_images.md"
	@echo "make pairs      measure stereo pairs, ideal, into docs/reports/pairs.md; two minutes"
	@echo "make stages     measure each stage of the fusion left out, on the tune half, into docs/reports/stages.md; half an hour"
	@echo "make sensitivity  halve and double each tuned number, on the tune half, into docs/reports/stages.md; half an hour"
	@echo "make conditions measure other responses, low light and misalignment into docs/reports/conditions.md; half an hour"
	@echo "make certainty  measure how well stated confidence holds into docs/reports/confidence.md; ten minutes"
	@echo "make alignment  measure how well bands are aligned into docs/reports/alignment.md; ten minutes"
	@echo "make paper-network  measure the paper's network, narrow and briefly trained, into docs/reports/paper.md"
	@echo "make paper-tables  the paper's Tables 1 and 2 by its network, into docs/reports/paper.md"
	@echo "make outside    fuse with disparities from elsewhere, into docs/reports/outside.md"
	@echo "make fields     every receptive field by the network pat-supervised, into docs/reports/paper.md"
	@echo "make trained-fields  the paper's network, narrow, trained anew with each field on PHOTOS=$(DATA)/photos/city100,"
	@echo "                into docs/reports/paper.md; half an hour of one core"
	@echo "make formats    the table of rig formats, from what their readers state, into docs/rigs.md"
	@echo "make without-rig  fuse with rigs found from the images, against known ones, into docs/reports/without_rig.md"
	@echo "make test       the tests"
	@echo "make test-long  the tests, longer ones included"
	@echo "make check      format, lint and types"
	@echo "make format     put the format right, and what lint can repair"
	@echo "make bench      measure attention and training"
	@echo "make bench-job  measure pat fuse as a command into docs/reports/performance.md, 15 minutes; QUICK=1: one size, a minute;"
	@echo "                AGAINST=FOLDER: another checkout too"
	@echo "make fuzz       read 6,000 damaged files, each in a process of its own; the table of docs/reports/fuzzing.md"
	@echo "make mistakes   fuse sixty inputs that are wrong without looking so; the table of docs/reports/mistakes.md"
	@echo "make kills      end commands with SIGKILL some 100 times, continue and compare; the table of docs/reports/kills.md"
	@echo "make transformations  torch's transformations of every operator; the table of docs/reports/transformations.md"
	@echo "make train      train on the images at hand; ARGS=... goes to 'pat lab train'"
	@echo "make synthesis  adds Blender (some 400 MB), to render scenes: in $(VENV)/blender, with what it needs"
	@echo "make notebooks  run the notebooks and keep what they put out"
	@echo "make docs       the documentation as a site, in out/site"
	@echo "make drawings   the documentation's drawings, and the gallery's figures"
	@echo "make wheel      build sdist and wheels, install them into empty environments and use them there;"
	@echo "                PYTHONS='python3.11 python3.12' ARGS=--lowest: more of them"
	@echo "make env        only the environment, in $(VENV)"

env: $(READY)

demo: $(READY)
	@echo "== fusing the sample array into out/demo"
	@$(BIN)/pat demo --out out/demo

showcase: $(READY)
	@echo "== fusing the images in $(DATA) into out/showcase"
	@$(BIN)/python -m experiments showcase --data $(DATA) --out out/showcase

readme: demo showcase
	@echo "== bringing docs/reports/demo.md and docs/reports/real_images.md up to date"
	@$(BIN)/python -m docs.update_readme --document docs/reports/demo.md --block demo=out/demo/demo.md \
		--image out/demo/demo.png docs/demo.jpg
	@$(BIN)/python -m docs.update_readme --document docs/reports/real_images.md --block showcase=out/showcase/showcase.md

pairs: $(READY)
	@$(BIN)/python -m experiments evaluate --middlebury $(DATA)/middlebury --rates 2 4 --half report --out out/pairs
	@$(BIN)/python -m docs.update_readme --document docs/reports/pairs.md --block pairs=out/pairs/scores.md

stages: $(READY)
	@$(BIN)/python -m experiments stages --middlebury $(DATA)/middlebury --out out/stages
	@$(BIN)/python -m docs.update_readme --document docs/reports/stages.md --block stages=out/stages/stages.md

sensitivity: $(READY)
	@$(BIN)/python -m experiments sensitivity --middlebury $(DATA)/middlebury --out out/sensitivity
	@$(BIN)/python -m docs.update_readme --document docs/reports/stages.md --block sensitivity=out/sensitivity/sensitivity.md

conditions: $(READY)
	@$(BIN)/python -m experiments conditions --middlebury $(DATA)/middlebury --half report --out out/conditions
	@$(BIN)/python -m docs.update_readme --document docs/reports/conditions.md --block conditions=out/conditions/conditions.md \
		--image out/conditions/conditions.png docs/reports/conditions.jpg

certainty: $(READY)
	@$(BIN)/python -m experiments certainty --middlebury $(DATA)/middlebury --out out/certainty
	@$(BIN)/python -m docs.update_readme --document docs/reports/confidence.md --block reliability=out/certainty/certainty.md \
		--image out/certainty/reliability.png docs/reports/reliability.jpg

without-rig: $(READY)
	@$(BIN)/python -m experiments evaluate --middlebury $(DATA)/middlebury --without-rig --rates 2 --half report --out out/without-rig
	@$(BIN)/python -m docs.update_readme --document docs/reports/without_rig.md --block without-rig=out/without-rig/scores.md

alignment: $(READY)
	@$(BIN)/python -m experiments alignment --data $(DATA) --out out/alignment \
		--scenes middlebury motorcycle rededge rededge_flight sequoia nine-band
	@$(BIN)/python -m docs.update_readme --document docs/reports/alignment.md --block alignment=out/alignment/alignment.md

formats: $(READY)
	@$(BIN)/python -m docs.formats

paper-network: $(READY)
	@$(BIN)/python -m experiments evaluate --middlebury $(DATA)/middlebury --rates 2 --half report \
		--network tests/benchmarks/paper-2-narrow.safetensors --out out/paper-network
	@$(BIN)/python -m docs.update_readme --document docs/reports/paper.md --block paper=out/paper-network/scores.md

gradients: $(READY)
	@$(BIN)/python -m experiments gradients --out out/gradients
	@$(BIN)/python -m docs.update_readme --document docs/reports/gradients.md --block gradients=out/gradients/gradients.md

outside: $(READY)
	@$(BIN)/python -m experiments outside --middlebury $(DATA)/middlebury --half report --out out/outside
	@$(BIN)/python -m docs.update_readme --document docs/reports/outside.md --block outside=out/outside/outside.md

paper-tables: $(READY)
	@$(BIN)/python -m experiments evaluate --kitti $(DATA)/kitti --flickr1024 $(DATA)/flickr1024 \
		--network pat-supervised --out out/table1
	@$(BIN)/python -m experiments evaluate --kitti $(DATA)/kitti --flickr1024 $(DATA)/flickr1024 \
		--protocol table2 --network pat-supervised-4 --out out/table2
	@$(BIN)/python -m docs.update_readme --document docs/reports/paper.md \
		--block table1=out/table1/scores.md --block table2=out/table2/scores.md

fields: $(READY)
	@$(BIN)/python -m experiments fields --middlebury $(DATA)/middlebury --out out/fields
	@$(BIN)/python -m docs.update_readme --document docs/reports/paper.md --block fields=out/fields/ablation.md

PHOTOS ?= $(DATA)/photos/city100

trained-fields: $(READY)
	@$(BIN)/python -m experiments trained-fields --photos $(PHOTOS) --out out/trained-fields
	@$(BIN)/python -m docs.update_readme --document docs/reports/paper.md --block trained-fields=out/trained-fields/trained.md \
		--image out/trained-fields/errors.png docs/reports/trained_fields.jpg

test: $(READY)
	@echo "== tests"
	@PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/python -m pytest -m "not slow" --numprocesses auto --dist worksteal

test-long: $(READY)
	@echo "== tests, longer ones included"
	@$(BIN)/python -m pytest

check: $(READY)
	@echo "== format"
	@$(BIN)/ruff format --check .
	@echo "== lint"
	@$(BIN)/ruff check .
	@echo "== types"
	@$(BIN)/mypy

format: $(READY)
	@$(BIN)/ruff format .
	@$(BIN)/ruff check --fix .

synthesis: $(READY)
	@echo "== installing Blender in $(VENV)/blender"
	@$(PIP) --editable '.[dev,synthesis]'
	@$(VENV)/blender/bin/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV)/blender
	@$(VENV)/blender/bin/python -m pip install -qq --disable-pip-version-check --no-input --requirement blender.txt \
		|| { rm -r $(VENV)/blender; exit 1; }

bench: $(READY)
	@$(BIN)/python -m tests.benchmarks.bench_attention
	@$(BIN)/python -m tests.benchmarks.bench_training

bench-job: $(READY)
	@$(BIN)/python -m tests.benchmarks.bench_job $(if $(QUICK),--quick) $(if $(AGAINST),--against $(AGAINST))
	@$(if $(QUICK),,$(BIN)/python -m docs.update_readme --document docs/reports/performance.md --block job=tests/benchmarks/RESULTS_job.md)

fuzz: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python -m tests.fuzz.run --out docs/reports/fuzzing.md

mistakes: $(READY)
	@$(BIN)/python -m tests.benchmarks.bench_mistakes --out docs/reports/mistakes.md

kills: $(READY)
	@OMP_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m tests.kills.run --out docs/reports/kills.md

transformations: $(READY)
	@OMP_NUM_THREADS=1 $(BIN)/python -m tests.transformations.run --out docs/reports/transformations.md

notebooks: $(READY)
	@$(BIN)/python notebooks/run.py

docs: $(READY)
	@NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "== out/site/index.html"

drawings: $(READY)
	@$(BIN)/python docs/drawings.py
	@$(BIN)/python -m docs.gallery

wheel:
	@$(PYTHON) tests/wheel/run.py --python $(or $(PYTHONS),$(PYTHON)) $(ARGS)

train: $(READY)
	@$(BIN)/pat lab train $(ARGS)

# An environment that works is kept and brought up to date; one that does not is made anew. torch goes first, alone
# and by its exact version, so that nothing else chooses a build of it.
$(READY): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, $(PYTHON) is " + sys.version.split()[0])'
	@echo "== making the environment in $(VENV) (once; some minutes)"
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(PYTHON) -m venv --clear $(VENV) \
		|| { echo "$(PYTHON) cannot make environments; on Debian and Ubuntu: apt-get install python3-venv"; exit 1; }
	@echo "== installing torch, the largest part"
	@$(PIP) torch
	@echo "== installing the rest"
	@$(PIP) --editable '.[dev]'
	@$(BIN)/pat warm-up
	@touch $@
