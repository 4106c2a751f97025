# Every target sets up what it needs: on a fresh machine `make demo` and `make test` need only Python 3.11 or later.

# The first Python that runs and is new enough. (A version manager may define names for versions that are not installed.)
NEW_ENOUGH := -c 'import sys; sys.exit(sys.version_info < (3, 11))'
ifndef PYTHON
PYTHON := $(shell for python in python3.13 python3.12 python3.11 python3; do \
  "$$python" $(NEW_ENOUGH) 2>/dev/null && echo "$$python" && break; done)
endif
VENV := .venv
comma := ,
BIN := $(VENV)/bin
VIDEO ?=
ARGS ?=

# Docker, or podman if docker does not run. The image's variant is cpu or gpu. BUILD_OPTIONS are further options for
# the engine's `build`.
ENGINE ?= $(if $(shell docker info >/dev/null 2>&1 || ! command -v podman || echo podman),podman,docker)
VARIANT ?= cpu
VERSION = $(shell sed -n 's/^__version__ = "\(.*\)"/\1/p' service/lanestream/__init__.py)
REVISION = $(shell git rev-parse HEAD 2>/dev/null || echo unknown)

# Marks what the environment was set up for. It is set up again when pyproject.toml changes.
RUN_READY := $(VENV)/.ready-run
DEV_READY := $(VENV)/.ready-dev
# The environment with onnxruntime for GPUs, which can't be in the same one as that for CPUs.
GPU_VENV := .venv-gpu
GPU_READY := $(GPU_VENV)/.ready
# The same for the packages of the JavaScript client; and its first compiled module.
JS_READY := client/js/node_modules/.ready
JS_BUILT := client/js/dist/index.js

.PHONY: attack batch-speed bench cluster-check gpu-check ray-test soak evaluate evaluate-tracking ablation models demo serve train-toy test lint lock asyncapi asyncapi-check chart fuzz picture moving-picture image image-test up compose-ready down up-check clean js js-types

demo: $(RUN_READY)
	$(BIN)/python tools/demo.py $(if $(VIDEO),"$(VIDEO)")

serve: $(RUN_READY)
	$(BIN)/lanestream serve

train-toy: $(DEV_READY)
	$(BIN)/python tools/train_toy.py

test: $(DEV_READY) $(JS_BUILT)
	$(BIN)/python -m pytest

lint: $(DEV_READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Builds the client for browsers and Node. Its modules for the live page are in the repository.
PAGE_CLIENT := service/lanestream/api/static/client

js: $(JS_BUILT)
	rm -rf $(PAGE_CLIENT)
	mkdir -p $(PAGE_CLIENT)
	cp client/js/dist/*.js $(PAGE_CLIENT)

# Its types of messages, from the service's JSON Schemas.
js-types: $(JS_READY) $(DEV_READY)
	$(BIN)/python tools/js_types.py

.PHONY: page-types demo-clip page-speed page-picture

# Checks the types in the modules of the live page, against those of the client.
page-types: $(JS_BUILT)
	rm -rf out/page-types
	mkdir -p out/page-types/client
	cp service/lanestream/api/static/*.js out/page-types
	cp client/js/dist/* out/page-types/client
	client/js/node_modules/.bin/tsc -p client/js/tsconfig.page.json

# The drive that the live page plays. It is in the repository.
demo-clip: $(DEV_READY)
	$(BIN)/python tools/demo_clip.py service/lanestream/api/static/demo.webm

# These need chromium.
page-speed: $(DEV_READY)
	$(BIN)/python tools/live_page.py speed $(ARGS)

page-picture: $(DEV_READY)
	$(BIN)/python tools/live_page.py picture docs/live-page.jpg

MODELS := service/lanestream/models

DATA ?= ../shared/data

# The names and the version of the shipped models.
AS_REGRESSOR := --name lanestream-regressor --version $(VERSION)
AS_CLASSIFIER := --name lanestream-alexnet --version $(VERSION)

# Trains networks like the shipped ones and writes them to out/. Takes hours on a CPU; continues after an interruption.
models: export LANESTREAM_DATA = $(DATA)
models: $(DEV_READY)
	mkdir -p out
	$(BIN)/lanestream train regressor --run runs/regressor
	$(BIN)/lanestream export runs/regressor/best.pt out/regressor-first.onnx
	$(BIN)/lanestream train classifier --run runs/classifier
	$(BIN)/lanestream export runs/classifier/best.pt out/classifier-first.onnx --regressor out/regressor-first.onnx
	$(BIN)/lanestream train regressor regressor-second --run runs/regressor-second --frames runs/regressor/frames
	$(BIN)/lanestream export runs/regressor-second/best.pt out/regressor.onnx $(AS_REGRESSOR)
	$(BIN)/lanestream train classifier classifier-second --run runs/classifier-second
	$(BIN)/lanestream export runs/classifier-second/best.pt out/classifier.onnx $(AS_CLASSIFIER) \
	  --regressor out/regressor.onnx
	$(BIN)/lanestream export runs/classifier-second/best.pt out/classifier-fp32.onnx $(AS_CLASSIFIER) \
	  --precision fp32 --regressor out/regressor.onnx
	$(BIN)/lanestream train checkpoint runs/regressor-second/best.pt out/regressor.pt
	$(BIN)/lanestream train checkpoint runs/classifier-second/best.pt out/classifier.pt

evaluate: $(DEV_READY)
	$(BIN)/lanestream evaluate --split test --model $(MODELS)/classifier.onnx --model $(MODELS)/regressor.onnx \
	  --out out --json out/evaluation.json
	$(BIN)/python tools/evaluation_tables.py out/evaluation.json

# Takes hours. ARGS='--against DIR' compares with another checkout.
evaluate-tracking: $(DEV_READY)
	$(BIN)/lanestream evaluate tracking --real -o out/tracking.json --plots out/tracking $(ARGS)

# Leaves out each stage of the candidate detector once; results are kept in out/, so that it can be interrupted.
ablation: $(DEV_READY)
	$(BIN)/python tools/ablation.py

# Compares with LitServe, too, if it is installed: .venv/bin/pip install -e '.[bench-litserve]'
bench: $(DEV_READY)
	PYTHONPATH=tools $(BIN)/python -m bench $(ARGS)

# Checks and measures everything on an NVIDIA GPU, in minutes; continues after an interruption. ARGS='--provider cpu' runs
# it without one.
gpu-check: $(GPU_READY)
	$(GPU_VENV)/bin/python tools/gpu_check.py $(ARGS)

# Measures one, two and three nodes on this machine, and checks the simulation with them. Takes about half an hour; goes
# on where it was interrupted. Needs redis-server, and root for the limits of the processor time.
.PHONY: capacity
capacity: $(DEV_READY)
	PYTHONPATH=tools $(BIN)/python -m capacity measure $(ARGS)
	PYTHONPATH=tools $(BIN)/python -m capacity check

# Measures how much of what the processors could do `lanestream batch` does. ARGS='VIDEO...' instead of rendered ones.
batch-speed: $(DEV_READY)
	$(BIN)/python tools/batch_speed.py $(ARGS)

CLUSTER_TESTS := $(addprefix tests/,integration/test_cluster.py integration/test_cluster_up.py unit/service/cluster unit/deploy/test_kuberay.py)

# Installs Ray, which is large, and tests what needs it on clusters of two and three nodes on this machine.
ray-test: $(DEV_READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[ray,cluster]'
	$(BIN)/python -m pytest tests/integration/test_batch_ray.py $(CLUSTER_TESTS)

# Tests the service on a Ray cluster of three nodes on this machine, with 24 streams, and prints what it measured.
cluster-check: $(DEV_READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[cluster]'
	CLUSTER_NODES=3 CLUSTER_STREAMS=24 $(BIN)/python -m pytest $(CLUSTER_TESTS)

# Attacks services that it starts on 127.0.0.1, and prints what normal cameras felt. Needs redis-server and faketime.
attack: $(DEV_READY)
	PYTHONPATH=tools $(BIN)/python -m attack $(ARGS)

asyncapi: $(DEV_READY)
	$(BIN)/python tools/asyncapi.py docs/asyncapi.yaml

# Updates what the Helm chart repeats: the version, the alerts, and the names and types of settings.
chart: $(DEV_READY)
	$(BIN)/python tools/chart.py

# Needs npm: the schema of AsyncAPI documents is published only there.
asyncapi-check: $(DEV_READY)
	npm install --silent --no-audit --no-fund --prefix out/asyncapi @asyncapi/specs@6
	$(BIN)/python tools/asyncapi.py docs/asyncapi.yaml out/asyncapi/node_modules/@asyncapi/specs/schemas/3.0.0.json

# Seconds per target. atheris builds on CPython 3.11 to 3.13.
FUZZ_S ?= 600

SOAK_MINUTES := 30

soak: $(DEV_READY)
	$(BIN)/python tools/soak.py --minutes $(SOAK_MINUTES)

fuzz: $(DEV_READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[fuzz]'
	$(BIN)/python tests/fuzz.py decoder -max_total_time=$(FUZZ_S) -print_final_stats=1
	$(BIN)/python tests/fuzz.py messages -max_total_time=$(FUZZ_S) -print_final_stats=1

LOCK = $(BIN)/uv pip compile --quiet --upgrade --universal --python-version 3.11 --generate-hashes \
  --custom-compile-command 'make lock'
BUILD_REQUIREMENTS := import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["build-system"]["requires"], sep="\n")

# Locks the packages of the images, and those that build our own: the newest versions that pyproject.toml allows.
lock: | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	$(LOCK) --extra service --extra cpu --extra openvino --extra redis --extra tracing -o docker/requirements-cpu.txt pyproject.toml
	$(LOCK) --extra service --extra gpu --extra redis --extra tracing -o docker/requirements-gpu.txt pyproject.toml
	$(BIN)/python -c '$(BUILD_REQUIREMENTS)' | $(LOCK) -o docker/requirements-build.txt -

.PHONY: docs docs-serve
docs docs-serve: export NO_MKDOCS_2_WARNING = 1
docs: $(DEV_READY)
	$(BIN)/mkdocs build

docs-serve: $(DEV_READY)
	$(BIN)/mkdocs serve

picture: $(RUN_READY)
	$(BIN)/python tools/picture.py docs/lanes.jpg

# Fails if a line in it is not a lane boundary of its scene.
moving-picture: $(DEV_READY)
	$(BIN)/python tools/moving_picture.py docs/lanes.webp

# Podman's own image format can't store a health check.
image:
	$(ENGINE) build $(if $(findstring podman,$(ENGINE)),--format docker) -f docker/Dockerfile --target $(VARIANT) \
	  $(if $(BASE_IMAGE),--build-arg BASE_IMAGE=$(BASE_IMAGE)) --build-arg VERSION=$(VERSION) --build-arg REVISION=$(REVISION) \
	  -t lanestream:$(VARIANT) $(BUILD_OPTIONS) .

image-test: $(RUN_READY)
	$(BIN)/python tools/image_check.py --target $(VARIANT)

up: compose-ready image
	docker/up $(ENGINE) $(VARIANT)

# Fails before the image is built, which takes minutes.
compose-ready:
	@docker/compose $(ENGINE) $(VARIANT) version >/dev/null

down:
	docker/compose $(ENGINE) $(VARIANT) down

# Runs all of compose.yaml, under a name of its own, and checks it from outside.
up-check: $(DEV_READY)
	$(BIN)/python tools/up_check.py --engine $(ENGINE) $(if $(BASE_IMAGE),--base-image $(BASE_IMAGE)) \
	  $(if $(BUILD_OPTIONS),--build-options "$(BUILD_OPTIONS)")

clean:
	rm -rf $(VENV) $(GPU_VENV) client/js/node_modules client/js/dist out .mypy_cache .ruff_cache .pytest_cache .hypothesis

$(VENV)/bin/python:
	@"$(PYTHON)" $(NEW_ENOUGH) 2>/dev/null || \
	  { echo "error: Python 3.11 or later is needed$(if $(PYTHON),$(comma) and $(PYTHON) is older or can't be run) (set PYTHON=...)" >&2; exit 1; }
	"$(PYTHON)" -m venv $(VENV) || { echo "error: no venv module (on Debian: apt install python3-venv)" >&2; exit 1; }

$(RUN_READY): pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[service,cpu,video]'
	@touch $@

$(DEV_READY): pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[service,cpu,openvino,redis,train,bench,docs,dev]'
	@touch $@ $(RUN_READY)

$(GPU_READY): pyproject.toml
	"$(PYTHON)" -m venv $(GPU_VENV)
	$(GPU_VENV)/bin/python -m pip install --quiet --disable-pip-version-check -e '.[gpu-check]'
	@touch $@

$(JS_READY): client/js/package-lock.json
	@command -v npm >/dev/null || { echo "error: no npm (on Debian: apt install nodejs npm)" >&2; exit 1; }
	@node -e 'process.exit(parseInt(process.versions.node) < 20 ? 1 : 0)' || { echo "error: Node 20 or later is needed" >&2; exit 1; }
	@cd client/js && npm ci --silent --ignore-scripts || \
	  { echo "error: the packages of client/js could not be installed: npm ci needs the npm registry" >&2; exit 1; }
	@touch $@

$(JS_BUILT): $(JS_READY) client/js/tsconfig.json $(wildcard client/js/src/*.ts)
	cd client/js && rm -rf dist && npm run --silent build
	@touch $@
