# Every target sets up its own environment in .venv; nothing else is installed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
NATIVE := CMakeLists.txt $(wildcard native/*)
DOCS_READY := $(VENV)/.docs-ready

.PHONY: demo test crash check format docs wheel bench bench-asterix sanitize fuzz clean soak

demo: $(READY)
	$(BIN)/saltus demo -o out/demo

# Compiled modules are kept: the tests start hundreds of processes, and each would compile the package anew.
test: $(READY)
	PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n auto

# Kill runs of the tracker at every call of the file system and at random moments.
KILLS ?= 200
crash: $(READY)
	$(BIN)/python tests/crashing.py --kills $(KILLS)
	$(BIN)/python tests/crashing.py --kills $(KILLS) --way in-place

# Simulated hours through the program: memory and time per report against length.
soak: $(READY)
	$(BIN)/python benchmarks/soak.py

check: $(READY)
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(READY)
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(DOCS_READY)
	$(BIN)/python -m sphinx -W -q -b html docs build/docs
	@echo "docs: build/docs/index.html"

# The wheel is built from the sdist, so a file missing there is noticed; for machines that are not known, with every
# instruction set. Its tools live in an environment of their own: .venv would compile the kernel once more.
wheel:
	$(PYTHON) -m venv build/wheel
	build/wheel/bin/python -m pip install -q --upgrade pip build==1.6.1
	SALTUS_ISAS=all build/wheel/bin/python -m build --outdir dist

# The peers that the benchmark compares with live in their own environment.
bench:
	$(PYTHON) -m venv build/bench
	build/bench/bin/python -m pip install -q --upgrade pip
	build/bench/bin/python -m pip install -q '.[bench]'
	build/bench/bin/python benchmarks/filter_speed.py -o benchmarks/results.json

# asterix_decoder is GPL and calls its module as libasterix does: it runs in an environment of its own.
bench-asterix: $(READY)
	$(PYTHON) -m venv build/bench-asterix
	build/bench-asterix/bin/python -m pip install -q asterix_decoder==0.7.11
	$(BIN)/python benchmarks/asterix_speed.py --peer build/bench-asterix/bin/python

# All compiled code under the address and undefined-behaviour sanitizers: the kernel for 1 to 9 states at the baseline and
# at the widest instruction set of the machine, the ASTERIX codec, framing. The environment borrows the tools of .venv.
# SANITIZED: the tests to run; CI runs the fewest that meet all code. SANITIZED_ISAS=all: AVX2 as well, a third more to
# compile. Python leaks at exit: leaks are not looked for.
SANITIZED_ISAS ?= native
SANITIZED ?= tests/native tests/asterix tests/framing tests/filters/test_imm.py tests/filters/test_bank.py \
  tests/filters/test_coloured.py tests/filters/test_hostile.py
sanitize: $(READY)
	$(PYTHON) -m venv build/sanitize
	SALTUS_REQUIRE_NATIVE=1 SALTUS_ISAS=$(SANITIZED_ISAS) build/sanitize/bin/python -m pip install -q --no-deps --force-reinstall . \
	  -C cmake.define.SALTUS_SANITIZE=ON -C build-dir=build/sanitize/cmake
	LD_PRELOAD="$$($${CXX:-g++} -print-file-name=libasan.so) $$($${CXX:-g++} -print-file-name=libstdc++.so)" \
	  ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 SALTUS_REQUIRE_NATIVE=1 \
	  PYTHONPATH="$$($(BIN)/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')" \
	  build/sanitize/bin/python -m pytest -n auto $(SANITIZED)

# Every reader under mutated inputs, guided by the branches they reach, for so many seconds each; with GUIDED=no by chance
# and for so many seconds in all, seeded. The guided fuzzer lives in an environment of its own that borrows the packages
# of .venv; where it has no wheel it is said and chance takes its place. What fails goes to tests/fuzz/corpus.
FUZZ_SECONDS ?= 900
GUIDED ?= yes
fuzz: $(READY)
	@if [ "$(GUIDED)" = yes ]; then \
	  mkdir -p build/fuzz && $(PYTHON) -m venv build/fuzz/venv || exit 1; \
	  if build/fuzz/venv/bin/python -m pip install -q --only-binary :all: atheris==3.0.0; then \
	    $(BIN)/python -c 'import sysconfig; print("import site; site.addsitedir(%r)" % sysconfig.get_path("purelib"))' \
	      > "$$(build/fuzz/venv/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/borrowed.pth"; \
	    for target in $$($(BIN)/python tests/fuzz/long.py --list); do \
	      build/fuzz/venv/bin/python tests/fuzz/long.py --guided --seconds $(FUZZ_SECONDS) --target $$target || exit 1; \
	    done; exit; \
	  fi; \
	  echo "make fuzz: atheris 3.0.0 cannot be installed for this Python: inputs are mutated by chance." >&2; \
	fi; \
	$(BIN)/python tests/fuzz/long.py --seconds $(FUZZ_SECONDS)

# Where there is a C++20 compiler the kernel must compile; where there is none, that is said and the package works.
$(READY): pyproject.toml $(NATIVE)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --upgrade pip
	@native="$${SALTUS_REQUIRE_NATIVE:-$$(sh scripts/cxx20)}"; \
	SALTUS_REQUIRE_NATIVE="$$native" $(BIN)/python -m pip install -q -e '.[dev]' || { \
	  [ "$$native" = 0 ] || echo "saltus: NOT INSTALLED: the compiled kernel was not built, see above." \
	    "SALTUS_REQUIRE_NATIVE=0 make ... goes on without it: filters run in NumPy, slower." >&2; exit 1; }
	@$(BIN)/python -c 'import importlib.util as u, sys; u.find_spec("saltus._native") or print("saltus: installed WITHOUT its compiled kernel: filters run in NumPy and recordings are read in Python, many times slower.\nInstall a C++20 compiler (g++ 11 or clang++ 14), touch pyproject.toml and make again.", file=sys.stderr)'
	@touch $@

# Only what the extra names: saltus itself is installed, and installing it again would compile it again.
$(DOCS_READY): $(READY)
	$(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["optional-dependencies"]["docs"], sep="\n")' \
	  | $(BIN)/python -m pip install -q -r /dev/stdin
	@touch $@

clean:
	rm -rf $(VENV) build dist out .pytest_cache .mypy_cache .ruff_cache
