"""Prints which names of ministack each fix replaces, and a hash of what stood there: a process of its own."""

from __future__ import annotations

import hashlib
import inspect
import json
import sys
from pathlib import Path
from typing import Any

from ministack import app  # noqa: F401 - with every service that is always loaded
from ministack.services import s3  # noqa: F401 - as above
from ministack.services.cloudformation import provisioners  # noqa: F401 - as above

from local.emulator import fixes
from local.persistence import streams
from local.persistence.ledger import Ledger


def names() -> dict[str, Any]:
    """Everything that has a name in a module or a class of ministack."""
    found = {}
    for module in [one for name, one in sys.modules.items() if name.startswith("ministack.")]:
        own = [
            one for one in vars(module).values() if inspect.isclass(one) and one.__module__ == module.__name__
        ]
        for owner in (module, *own):
            found |= {f"{owner.__name__}.{name}": value for name, value in vars(owner).items()}
    return found


def seen(value: Any) -> str:
    """A hash of a function's source or of a text; of anything else its kind."""
    if inspect.isroutine(value):
        value = inspect.getsource(inspect.unwrap(value))
    return hashlib.sha256(value.encode()).hexdigest()[:12] if isinstance(value, str) else type(value).__name__


def main() -> None:
    streams.install(Ledger(Path(sys.argv[1])))
    told, before = {}, names()
    for name, close in fixes.every():
        close()
        after = names()
        told[name] = {key: seen(before[key]) for key in sorted(before) if after[key] is not before[key]}
        before = after
    print(json.dumps(told))  # noqa: T201 - its answer


if __name__ == "__main__":
    main()
