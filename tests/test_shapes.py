"""Shapes in annotations are executed here and cost a user nothing."""

import subprocess
import sys

import numpy as np
import pytest
from beartype.roar import BeartypeCallHintViolation

from saltus.linalg import quadratic_form


def test_a_shape_that_does_not_fit_is_found():
    with pytest.raises(BeartypeCallHintViolation):
        quadratic_form(np.ones((2, 3)), np.ones((3, 2)))  # B is square
    assert quadratic_form(np.ones((2, 3)), np.eye(3)).shape == (2, 2)


def test_a_program_does_not_pay_for_them():
    """In a process of its own, since this one has imported everything."""
    code = (
        "import sys, numpy, saltus.run.command, saltus.filters, saltus.tracks.local\n"
        "print([m for m in ('jaxtyping', 'beartype', 'scipy.signal', 'scipy.stats') if m in sys.modules])\n"
        "print(saltus.linalg.symmetric.__annotations__['a'] is numpy.ndarray)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split("\n")[:2] == ["[]", "True"]
