"""The layer has the packages of its target, and two builds give the same bytecode."""

from __future__ import annotations

import hashlib
import importlib.util
import re
import shutil
import struct
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from scripts.layer import LAMBDA, LAYERS, LOCAL, ROOT, Layer, build, trim
from stacks.parts import FOLDERS

# The second word of an unchecked-hash .pyc: PEP 552.
UNCHECKED_HASH = 0b01
CODE = "import sys\n\nSETS = {'a', 'b', 'c'}\nanswer = lambda text: text in {'x', 'y', 'z'}\n"


def wheel(folder, name):
    """Writes a wheel of one module and returns its SHA-256."""
    path = folder / f"{name}-1.0-py3-none-any.whl"
    info = f"{name}-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{name}/__init__.py", CODE)
        archive.writestr(f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n")
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n")
        archive.writestr(f"{info}/entry_points.txt", f"[console_scripts]\n{name} = {name}:answer\n")
        archive.writestr(
            f"{info}/RECORD",
            "".join(f"{one},,\n" for one in [*archive.namelist(), f"{info}/RECORD"]),
        )
    return hashlib.sha256(path.read_bytes()).hexdigest()


@pytest.fixture
def requirements(tmp_path, monkeypatch):
    """A lock file of packages for Lambda's Python, for its machine and for this one."""
    host = "{}.{}".format(*sys.version_info)
    markers = {
        "everywhere": "python_version >= '3'",
        "lambda_python": f"python_version == '{LAMBDA.python}'",
        "lambda_full": f"python_full_version >= '{LAMBDA.python}.0' and python_version <= '{LAMBDA.python}'",
        "lambda_machine": "platform_machine == 'aarch64' and sys_platform == 'linux'",
        "this_python": f"python_version == '{host}'",
        "never": "sys_platform == 'win32'",
    }
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    # No registry is contacted.
    monkeypatch.setenv("UV_NO_INDEX", "1")
    monkeypatch.setenv("UV_FIND_LINKS", str(wheels))
    locked = tmp_path / "layer.txt"
    locked.write_text(
        "".join(f"{n}==1.0 ; {m} \\\n    --hash=sha256:{wheel(wheels, n)}\n" for n, m in markers.items())
    )
    return locked


def names(layer):
    return {path.name for path in (layer / "python").iterdir() if not path.name.endswith(".dist-info")}


def test_markers_are_evaluated_for_the_target(requirements, tmp_path):
    build(tmp_path / "layer", Layer(LAMBDA, requirements), None)
    expected = {"everywhere", "lambda_python", "lambda_full", "lambda_machine"}
    if LAMBDA.python == LOCAL.python:
        expected.add("this_python")
    assert names(tmp_path / "layer") == expected
    build(tmp_path / "here", Layer(LOCAL, requirements), None)
    assert names(tmp_path / "here") >= {"everywhere", "this_python"}
    assert ("lambda_python" in names(tmp_path / "here")) == (LAMBDA.python == LOCAL.python)


def test_a_file_with_another_hash_than_the_locked_one_is_refused(requirements, tmp_path):
    other = "0" * 64
    requirements.write_text(
        re.sub("sha256:[0-9a-f]{64}", f"sha256:{other}", requirements.read_text(), count=1)
    )
    with pytest.raises(subprocess.CalledProcessError):
        build(tmp_path / "layer", Layer(LAMBDA, requirements), None)


def test_bytecode_is_unchecked_and_reproducible(requirements, tmp_path):
    first, second = tmp_path / "layer", tmp_path / "elsewhere" / "deeper"
    build(first, Layer(LAMBDA, requirements), sys.executable)
    build(second, Layer(LAMBDA, requirements), sys.executable)
    files = {path.relative_to(first): path.read_bytes() for path in first.rglob("*") if path.is_file()}
    assert files == {p.relative_to(second): p.read_bytes() for p in second.rglob("*") if p.is_file()}
    modules = [path for path in files if path.suffix == ".py"]
    compiled = [path for path in files if path.suffix == ".pyc"]
    assert len(compiled) == len(modules) > 0
    for path in compiled:
        assert files[path][:4] == importlib.util.MAGIC_NUMBER
        assert struct.unpack("<I", files[path][4:8]) == (UNCHECKED_HASH,)
        assert str(tmp_path).encode() not in files[path]


def test_a_layer_without_a_compiler_has_no_bytecode(requirements, tmp_path):
    build(tmp_path / "layer", Layer(LAMBDA, requirements), None)
    assert not list((tmp_path / "layer").rglob("*.pyc"))


# "Lambda quotas": the code and its layers, unzipped.
MOST_BYTES = 250 * 1000**2
WRITE = """
import io, json
from iort_analysis.archive.reading import items
from iort_analysis.archive.reading import ArchiveFile
from iort_analysis.archive.writing import write_hour
from iort_contract.archive import hour_of
from iort_contract.messages.batch import Batch, encode_batch, decode_batch
from iort_contract.dynamodb import plain

batch = Batch("0123abcd", 0, [5, 6], {"speed": [1.5, None], "mode": ["go", "é"], "odd": [1, "a"]})
envelope = json.loads(encode_batch(batch))
item = {name: {"N": str(value)} if type(value) is int else {"S": value} for name, value in envelope.items()}
into = io.BytesIO()
write_hour([item], into, hour=hour_of(5), refused=io.BytesIO(), scratch=io.BytesIO())
(again,) = items(ArchiveFile(into.getvalue()), "dt/iort/car/vesc")
assert decode_batch(plain(again)) == batch
(part,) = ArchiveFile(into.getvalue()).pages(messages=False)
assert part.block.columns["mode"].tolist() == ["go", "é"]
import numpy, pyarrow.parquet
metadata = pyarrow.parquet.ParquetFile(io.BytesIO(into.getvalue())).metadata
assert metadata.row_group(0).column(0).compression == "ZSTD"
print(numpy.__file__, pyarrow.__file__)
"""


def size_of(folder):
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


@pytest.mark.slow
def test_the_analysis_layer_works_without_what_is_trimmed_and_fits_into_a_function(tmp_path):
    """This machine's numpy and pyarrow, trimmed like AWS', without any other package."""
    layer, code = tmp_path / "layer", tmp_path / "code"
    for module in ("numpy", "pyarrow"):
        installed = Path(importlib.util.find_spec(module).origin).parent
        for folder in [installed, *installed.parent.glob(f"{module}.libs")]:
            shutil.copytree(folder, layer / folder.name)
    trim(layer, LAYERS["analysis"].unused)
    for folder in FOLDERS:
        shutil.copytree(ROOT / folder, code / Path(folder).name)
    # Without "site" there are no installed packages.
    path = f"import sys; sys.path += {[str(layer), str(code)]}"
    done = subprocess.run(
        [sys.executable, "-I", "-S", "-c", f"{path}\n{WRITE}"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(str(layer)) == 2
    assert size_of(layer) + size_of(code) < 0.8 * MOST_BYTES
