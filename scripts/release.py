"""Builds, checks and tags a release: `make wheels`, `make wheelhouse`, `make release`.

The version is that of contract/pyproject.toml; `python -m scripts.release version 0.4.0` writes it
everywhere. The same commit gives the same bytes: they depend on its sources and its time alone.
"""

from __future__ import annotations

import argparse
import gzip
import hashlib
import os
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
DIST = ROOT / "dist"
DISTRIBUTIONS = ("contract", "device", "analysis", "station")
# They install packages and wheelhouses into empty environments, and run what the manual tells a user to type.
PROOF = "tests/local/commands/test_release.py"
PROOF_OF_WHEELHOUSES = "tests/local/test_wheelhouse.py"
_PAGE = "iort_station/page/built/index.html"
_NUMBER = r"\d+\.\d+\.\d+"
# Where a distribution states a version, of itself or of another one.
_PLACES = {
    "pyproject.toml": r'(?m)(^version = "|"iort-\w+==)NUMBER"',
    "package.xml": r"(<version>)NUMBER</",
    "setup.py": r'(version=")NUMBER"',
}


class ReleaseError(Exception):
    """A release that must not be made; the text says what to do."""


def version(root: Path = ROOT) -> str:
    """The version of all parts."""
    return versions(root)[root / "contract" / "pyproject.toml"][0]


def versions(root: Path = ROOT) -> dict[Path, list[str]]:
    """Every version that a part states, of itself or of another part, by its file."""
    return {
        path: [found[2] for found in re.finditer(pattern, path.read_text())]
        for path, pattern in _places(root)
    }


def set_version(number: str, root: Path = ROOT) -> None:
    """Write a version into every file that states one."""
    if not re.fullmatch(_NUMBER, number):
        raise ReleaseError(f"the version must be three numbers such as 1.2.3, got {number!r}")
    for path, pattern in _places(root):
        path.write_text(re.sub(pattern, lambda found: found[0].replace(found[2], number), path.read_text()))


def _places(root: Path) -> Iterator[tuple[Path, str]]:
    for folder in DISTRIBUTIONS:
        for name, pattern in _PLACES.items():
            if (path := root / folder / name).exists():
                yield path, pattern.replace("NUMBER", f"({_NUMBER})")


def refuse(root: Path = ROOT, *, tag: bool = False, built: str | None = None) -> str:
    """Return the checkout's commit, which may become, or is, the release of its version.

    Raises ReleaseError if it must not, and if it is not the one that was ``built``.
    """
    number = version(root)
    # A user's configuration may hide what is not tracked.
    changed = _git(root, "status", "--porcelain", "--untracked-files=normal", "--ignore-submodules=none")
    if changed:
        raise ReleaseError(f"the checkout must have no change that is not committed, got\n{changed}")
    head, tagged = _git(root, "rev-parse", "HEAD"), _git(root, "tag", "--list", f"v{number}")
    if built not in {None, head}:
        raise ReleaseError(f"the checkout must stay at {built}, which is built, got {head}: make it again")
    # Who has checked a tag out may build it again, and compare the bytes.
    if tagged and (tag or _git(root, "rev-parse", f"v{number}^{{commit}}") != head):
        raise ReleaseError(
            f"{number} must not be tagged yet, got the tag v{number}: set the next version with "
            "`python -m scripts.release version NUMBER`"
        )
    changelog = (root / "CHANGELOG.md").read_text()
    if not re.search(rf"(?m)^## {re.escape(number)} - \d{{4}}-\d\d-\d\d$", changelog):
        headings = re.findall(r"(?m)^## .*", changelog) or ["no section"]
        raise ReleaseError(
            f"CHANGELOG.md must have a section '## {number} - DATE', got '{headings[0]}' first"
        )
    return head


def build(out: Path) -> list[Path]:
    """Build sdists and, from them, wheels into a folder, without a network; their paths."""
    if not (ROOT / "station" / _PAGE).is_file():
        raise ReleaseError(f"the live page must be built (station/{_PAGE} is missing): run `make setup`")
    out.mkdir(parents=True, exist_ok=True)
    return [path for folder in DISTRIBUTIONS for path in _build(folder, out)]


def _build(folder: str, out: Path) -> tuple[Path, Path]:
    # In a copy: setuptools leaves build/lib behind and would pack a deleted module from there again.
    with tempfile.TemporaryDirectory() as scratch:
        source, made = Path(scratch) / folder, Path(scratch) / "made"
        left_out = shutil.ignore_patterns("build", "*.egg-info", "__pycache__", "web")
        shutil.copytree(ROOT / folder, source, ignore=left_out)
        shutil.copy(ROOT / "LICENSE", source)
        if folder == "station":
            # What `iort mcp` offers to read.
            pages = shutil.ignore_patterns("examples", "images", "*.json", "*.svg", "*.ipynb")
            shutil.copytree(ROOT / "docs", source / "iort_station" / "documents", ignore=pages)
        # The locked setuptools of .venv, as for the checkout itself.
        command = [BIN / "uv", "build", "--quiet", "--offline", "--no-build-isolation"]
        command += ["--python", sys.executable, "--out-dir", made]
        _run(*command, "--sdist", source)
        (sdist,) = made.glob("*.tar.gz")
        with tarfile.open(sdist) as archive:
            archive.extractall(Path(scratch) / "unpacked", filter="data")
        sdist = pack(next((Path(scratch) / "unpacked").iterdir()), out / sdist.name)
        # From the sdist, which therefore has all that a build needs.
        _run(*command, "--wheel", sdist)
        (wheel,) = made.glob("*.whl")
        return sdist, Path(shutil.copy(wheel, out))


def pack(folder: Path, archive: Path) -> Path:
    """Pack a folder into a .tar or .tar.gz that is the same for the same contents."""

    def plain(info: tarfile.TarInfo) -> tarfile.TarInfo:
        info.uid = info.gid = 0
        info.uname = info.gname = ""
        info.mtime = _epoch()
        info.mode = 0o755 if info.isdir() or info.mode & 0o100 else 0o644
        return info

    with archive.open("wb") as file:
        if archive.suffix == ".gz":
            with (
                gzip.GzipFile("", "wb", fileobj=file, mtime=_epoch()) as packed,
                tarfile.open(fileobj=packed, mode="w") as tar,
            ):
                tar.add(folder, folder.name, filter=plain)
        else:
            with tarfile.open(fileobj=file, mode="w") as tar:
                tar.add(folder, folder.name, filter=plain)
    return archive


def check(built: Iterable[Path]) -> None:
    """Look at what was built as the index would, and at the wheels' contents."""
    files = list(built)
    _run(BIN / "twine", "check", "--strict", *files)
    _run(BIN / "check-wheel-contents", *(path for path in files if path.suffix == ".whl"))


def sums(files: Iterable[Path], out: Path) -> None:
    """Write the files' hashes as `sha256sum --check` reads them."""
    lines = [f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {path.name}\n" for path in sorted(files)]
    (out / "SHA256SUMS").write_text("".join(lines))


def release(*, architectures: Sequence[str], tag: bool) -> None:
    """Build into dist/, check it, install it and run the manual's commands with it; then tag, if asked."""
    commit = refuse(tag=tag)
    built = make(architectures)
    check(built)
    tests = [PROOF, *([PROOF_OF_WHEELHOUSES] if architectures else [])]
    _run(sys.executable, "-m", "pytest", *tests, show=True, IORT_DIST=str(DIST))
    # Building and trying it take minutes, in which somebody may have gone on.
    refuse(tag=tag, built=commit)
    if tag:
        _git(ROOT, "tag", "--annotate", f"v{version()}", commit, "--message", f"iort {version()}")
        print(f"tagged v{version()}; `git push origin v{version()}` publishes the tag")


def make(architectures: Sequence[str], dist: Path = DIST) -> list[Path]:
    """Fill dist/ with what the checkout has now: packages, wheelhouses and their hashes, all or nothing."""
    from scripts import wheelhouse  # noqa: PLC0415 - it imports this module

    for architecture in architectures:
        wheelhouse.check_architecture(architecture)
    with tempfile.TemporaryDirectory(prefix="release.", dir=_scratch()) as scratch:
        part = Path(scratch) / dist.name
        built = build(part)
        houses = [wheelhouse.make(architecture, built, part) for architecture in architectures]
        sums([*built, *houses], part)
        if dist.exists():
            shutil.rmtree(dist)
        part.rename(dist)
    made = [dist / path.name for path in [*built, *houses]]
    for path in made:
        print(os.path.relpath(path, ROOT))
    return made[: len(built)]


def _scratch() -> Path:
    """A folder on the checkout's own disk, which Git ignores."""
    folder = ROOT / "build"
    folder.mkdir(exist_ok=True)
    return folder


def _epoch() -> int:
    return int(os.environ.get("SOURCE_DATE_EPOCH") or _git(ROOT, "log", "-1", "--format=%ct"))


def _git(root: Path, *arguments: str) -> str:
    command = ["git", "-C", str(root), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise ReleaseError(f"`git {' '.join(arguments)}` must succeed, got: {done.stderr.strip()}")
    return done.stdout.strip()


def _run(*command: object, show: bool = False, **environment: str) -> None:
    """Run a command; raises ReleaseError with what it said if it fails."""
    done = subprocess.run(
        list(map(str, command)),
        cwd=ROOT,
        env={**os.environ, "SOURCE_DATE_EPOCH": str(_epoch()), **environment},
        stdout=None if show else subprocess.PIPE,
        stderr=None if show else subprocess.STDOUT,
        text=True,
        check=False,
        umask=0o022,
    )
    if done.returncode:
        raise ReleaseError(f"`{' '.join(map(str, command))}` failed:\n{done.stdout or 'see above'}")


def main() -> None:
    """Do what the command line says."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    what = parser.add_subparsers(dest="what", required=True)
    setting = what.add_parser("version", help="print the version, or set it everywhere")
    setting.add_argument("number", nargs="?")
    for name in ("build", "release"):
        verb = what.add_parser(name)
        verb.add_argument("--wheelhouse", nargs="*", default=[], metavar="ARCHITECTURE")
    verb.add_argument("--tag", action="store_true", help="make the annotated tag, in this checkout only")
    asked = parser.parse_args()
    try:
        if asked.what == "version" and asked.number:
            set_version(asked.number)
        elif asked.what == "version":
            print(version())
        elif asked.what == "build":
            make(asked.wheelhouse)
        else:
            release(architectures=asked.wheelhouse, tag=asked.tag)
    except ReleaseError as error:
        sys.exit(f"release: {error}")


if __name__ == "__main__":
    main()
