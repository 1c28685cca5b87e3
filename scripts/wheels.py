"""Builds the wheels of iort-contract, iort-agent, iort-analysis and iort-station: `make wheels`."""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
DISTRIBUTIONS = ("contract", "device", "analysis", "station")
_PAGE = Path("station/iort_station/page/built/index.html")


def build(out: Path) -> list[Path]:
    """Build all of them into a folder, without a network; the wheels' paths."""
    if not (ROOT / _PAGE).is_file():
        raise FileNotFoundError(f"the live page is not built ({_PAGE} is missing): run `make setup`")
    return [_build(folder, out) for folder in DISTRIBUTIONS]


def _build(folder: str, out: Path) -> Path:
    # In a copy: setuptools leaves build/lib behind and would pack a deleted module from there again.
    with tempfile.TemporaryDirectory() as scratch:
        source, made = Path(scratch) / folder, Path(scratch) / "made"
        left_out = shutil.ignore_patterns("build", "*.egg-info", "__pycache__", "web")
        shutil.copytree(ROOT / folder, source, ignore=left_out)
        shutil.copy(ROOT / "LICENSE", source)
        # The locked setuptools of .venv, as for the checkout itself.
        command = [str(Path(sys.executable).parent / "uv"), "build", "--quiet", "--offline", "--wheel"]
        command += ["--no-build-isolation", "--python", sys.executable, "--out-dir", str(made), str(source)]
        subprocess.run(command, check=True)
        (wheel,) = made.glob("*.whl")
        out.mkdir(parents=True, exist_ok=True)
        return Path(shutil.copy(wheel, out))


def main() -> None:
    """Build them where the command line says."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--out", type=Path, default=ROOT / "dist")
    for wheel in build(parser.parse_args().out):
        print(wheel)


if __name__ == "__main__":
    main()
