"""How soon `posekit --help` answers, beside an interpreter that does nothing.

    python benchmarks/start.py [--runs 10]

The aim is under half a second; what makes it so, that neither torch nor OpenGL is loaded, is tested.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time


def fastest(arguments: list[str], runs: int) -> float:
    """Seconds of wall clock, the least of ``runs``."""
    seconds = []
    for _ in range(runs):
        started = time.perf_counter()
        subprocess.run([sys.executable, *arguments], check=True, capture_output=True)
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=10)
    runs = parser.parse_args().runs
    nothing, help_ = fastest(["-c", "pass"], runs), fastest(["-m", "posekit", "--help"], runs)
    print(f"python: {nothing:.2f} s; posekit --help: {help_:.2f} s; ratio {help_ / nothing:.1f}")


if __name__ == "__main__":
    main()
