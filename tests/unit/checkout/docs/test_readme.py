"""The README says what the code does."""

from __future__ import annotations

import re

from scripts.docs_parts import ROOT

README = (ROOT / "README.md").read_text()


def test_the_agent_knows_the_settings_of_car_yaml(tmp_path):
    from iort_agent.config import load_config

    page = (ROOT / "docs/reference/car-yaml.md").read_text()
    text = next(block for block in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL))
    (tmp_path / "car.yaml").write_text(text)
    for name in ("certificate.pem", "private.key"):
        (tmp_path / name).touch()
    assert load_config(tmp_path / "car.yaml").robot == "car7"


def test_the_readme_is_a_page():
    assert len(README.splitlines()) <= 150


def test_every_make_target_that_is_named_exists():
    pages = [page for page in (*ROOT.glob("*.md"), *ROOT.glob("docs/*/*.md")) if page.name != "CHANGELOG.md"]
    text = "\n".join(page.read_text() for page in pages)
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    shell = "\n".join(re.findall(r"^```sh\n(.*?)^```", text, re.DOTALL | re.MULTILINE))
    named = set(re.findall(r"`make ([a-z-]+)", text)) | set(
        re.findall(r"^make ([a-z-]+)", shell, re.MULTILINE)
    )
    assert len(named) > 20
    assert named <= targets


def test_every_file_linked_in_the_readme_exists():
    for link in re.findall(r"\]\(([^)h#][^)#]*)(?:#[^)]*)?\)", README):
        assert (ROOT / link).exists(), link


def test_every_decision_has_its_own_number():
    records = sorted((ROOT / "docs" / "decisions").glob("*/*.md"), key=lambda path: path.name)
    numbers = [int(path.name[:4]) for path in records]
    assert numbers == sorted(set(numbers))
    for path, number in zip(records, numbers, strict=True):
        assert path.read_text().startswith(f"# {number}. "), path.name


def test_every_file_linked_in_the_documentation_exists():
    for page in (ROOT / "docs").rglob("*.md"):
        for link in re.findall(r"\]\(([^)#:]+)(?:#[^)]*)?\)", page.read_text()):
            assert (page.parent / link).exists(), f"{page.name}: {link}"
