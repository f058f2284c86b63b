"""What the tests of the compiled kernel share; they skip where it was not built."""

import os
from contextlib import contextmanager

import pytest

from saltus.compiled import native_module

ISAS = [] if native_module() is None else native_module().instruction_sets()


def pytest_generate_tests(metafunc):
    absent = [pytest.param("", marks=pytest.mark.skip("the kernel was not built"))]
    if "isa" in metafunc.fixturenames:
        metafunc.parametrize("isa", ISAS or absent)
    if "other_isa" in metafunc.fixturenames:  # all but the widest, under which the other tests run
        metafunc.parametrize("other_isa", ISAS[1:] or absent)


@pytest.fixture(autouse=True)
def kernel():
    if native_module() is None:
        pytest.skip("the kernel was not built")


@pytest.fixture(scope="session")
def using():
    """A context in which the kernel of one instruction set is in use."""

    @contextmanager
    def context(isa):
        before = os.environ.get("SALTUS_ISA")
        os.environ["SALTUS_ISA"] = isa
        try:
            yield
        finally:
            os.environ.pop("SALTUS_ISA") if before is None else os.environ.update(SALTUS_ISA=before)

    return context
