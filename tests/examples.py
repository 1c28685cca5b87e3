"""How many examples hypothesis makes: a test's own number, and a tenth of it under `make test-fast`."""

from __future__ import annotations

from hypothesis import settings

# hypothesis' own number, which the profiles of tests/conftest.py scale.
_USUAL = 100


def examples(usual: int) -> settings:
    """`usual` examples, or as much fewer as the profile makes."""
    return settings(max_examples=usual * settings().max_examples // _USUAL)
