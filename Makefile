# Every target sets up what it needs by itself: a virtual environment in .venv with a CPU build of torch.
# CUDA instead of CPU:  make install CUDA=1        another interpreter:  make install PYTHON=python3.12

PYTHON ?= python3
VENV   := .venv
RUN    := $(VENV)/bin/python
READY  := $(VENV)/.ready

# A folder of wheels that offers torch (PIP_FIND_LINKS) is used as it is; elsewhere uv picks the build for CPU or CUDA.
LOCAL_TORCH := $(firstword $(wildcard $(addsuffix /torch-*.whl,$(PIP_FIND_LINKS))))
TORCH_BUILD := $(if $(LOCAL_TORCH),,--torch-backend $(if $(CUDA),auto,cpu))
EXTRAS      := dev$(if $(CUDA),$(comma)gsplat)
comma       := ,

# Where it is set, each of the hundreds of processes that the tests start would compile every module of every package again.
unexport PYTHONDONTWRITEBYTECODE

.DEFAULT_GOAL := help
.PHONY: help install demo test test-slow wheel-test docs lint format bench stability fuzz tensorboard clean

help:  ## list these targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-12s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(READY)  ## set up the environment and nothing else (CUDA=1 for a CUDA build of torch and gsplat)

$(READY): pyproject.toml constraints/torch.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "heatsplat needs Python 3.11 or newer; '$(PYTHON)' is older. Try: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; }
	@echo "Setting up $(VENV) (about a minute, 2 GB)"
	@test -x $(RUN) || $(PYTHON) -m venv $(VENV)
	@$(RUN) -m pip install -q --disable-pip-version-check uv
	@UV_FIND_LINKS="$(PIP_FIND_LINKS)" $(RUN) -m uv pip install -q --python $(RUN) $(TORCH_BUILD) -c constraints/torch.txt -e '.[$(EXTRAS)]'
	@touch $@

demo: $(READY)  ## train ETGS on the embedded synthetic scene, about a minute; ends with the metrics and a picture
	@$(RUN) src/train.py method=etgs preset=balanced $(ARGS)

test: $(READY)  ## run the tests, side by side on up to four cores (a file's tests stay together)
	@$(RUN) -m pytest -m "not slow" -n auto --maxprocesses 4 --dist loadfile --no-loadscope-reorder $(ARGS)

test-slow: $(READY)  ## run the tests that take minutes
	@$(RUN) -m pytest -m slow $(ARGS)

wheel-test: $(READY)  ## build the wheel, and train from it in an environment of its own
	@UV_FIND_LINKS="$(PIP_FIND_LINKS)" TORCH_BUILD="$(TORCH_BUILD)" .ci/wheel

docs: $(READY)  ## build the documentation, with a reference of every module, as a site in build/site
	@UV_FIND_LINKS="$(PIP_FIND_LINKS)" $(RUN) -m uv pip install -q --python $(RUN) $(TORCH_BUILD) -c constraints/torch.txt -r pyproject.toml --extra docs
	@NO_MKDOCS_2_WARNING=1 $(RUN) -m mkdocs build -q && echo "site: build/site/index.html"

lint: $(READY)  ## check style and formatting
	@$(RUN) -m ruff check . && $(RUN) -m ruff format --check .

format: $(READY)  ## mend style and formatting
	@$(RUN) -m ruff check --fix -q . ; $(RUN) -m ruff format -q .

bench: $(READY)  ## time the renderer against its peers and its floor; adds a line to benchmarks/history.jsonl and draws it
	@$(RUN) src/study.py study=renderer study.history=$(CURDIR)/benchmarks/history.jsonl $(ARGS)
	@$(RUN) src/study.py study=history

stability: $(READY)  ## measure the hard cases of arithmetic and write docs/stability.md
	@$(RUN) src/study.py study=stability $(ARGS)

fuzz: $(READY)  ## read damaged scenes and files for two hours (ARGS=60 for two minutes) and count what became of them
	@OMP_NUM_THREADS=1 $(RUN) tests/fuzz/readers.py $(or $(ARGS),3600)
	@OMP_NUM_THREADS=1 $(RUN) tests/fuzz/files.py $(or $(ARGS),3600)

tensorboard: $(READY)  ## look at all runs in TensorBoard
	@$(VENV)/bin/tensorboard --logdir outputs

clean:  ## remove the environment and caches (outputs/ stays)
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis build *.egg-info src/*.egg-info
