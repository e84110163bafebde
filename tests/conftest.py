"""What all tests share: signals as a terminal has them, and the bench on which contracts are tried with --hardware.

A runner that is started in the background or by nohup ignores SIGINT or SIGHUP, and gonio rightly leaves ignored signals
ignored; the tests of its handlers need the ordinary ones.
"""

from __future__ import annotations

import signal

import pytest

for _name in ("SIGINT", "SIGTERM", "SIGHUP"):
    _number = getattr(signal, _name, None)
    if _number is not None and signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.default_int_handler if _name == "SIGINT" else signal.SIG_DFL)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--hardware", metavar="RIG.TOML", help="try the contracts of devices on this rig too; its axes move")
