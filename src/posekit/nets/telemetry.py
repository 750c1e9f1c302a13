"""OpenVINO reports its use to Intel, when it is imported and when it converts, and makes ~/intel for it."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def without_telemetry() -> Iterator[None]:
    """Keep OpenVINO from reporting: it does not where the environment's CI is "true". Around its import, too."""
    before = os.environ.get("CI")
    os.environ["CI"] = "true"
    try:
        yield
    finally:
        if before is None:
            del os.environ["CI"]
        else:
            os.environ["CI"] = before
