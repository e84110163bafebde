"""The bench that the tests of the servo driver share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.servo_bench import Bench


@pytest.fixture
def bench() -> Iterator[Bench]:
    bench = Bench()
    yield bench
    bench.close()
