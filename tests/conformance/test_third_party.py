"""Other people's programs agree with gonio's models, each within what limits it.

They are not among what tests need: ``make conformance`` installs them, runs this file and writes docs/models.md.
"""

from __future__ import annotations

import pytest

from tests.conformance.third_party import Comparison, everything


@pytest.mark.parametrize("comparison", everything(), ids=str)
def test_a_program_of_others_agrees(comparison: Comparison) -> None:
    pytest.importorskip(comparison.program)
    assert comparison.difference <= comparison.limit, comparison.limited_by
