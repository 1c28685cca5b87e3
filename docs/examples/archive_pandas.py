"""The mean speed of each day from a copy of the archive, with pandas.

aws s3 sync s3://BUCKET/archive/robot=car7 archive/robot=car7
python docs/examples/archive_pandas.py archive car7 vesc
"""

import sys
from pathlib import Path

import pandas as pd


def samples(day: Path, columns: list[str]) -> pd.DataFrame:
    """A day's samples. An hour that has a file of its own counts from there, not from the day's file."""
    hours = {file.stem: file for file in sorted(day.glob("[0-2][0-9].parquet"))}
    parts = [pd.read_parquet(file, columns=columns) for file in hours.values()]
    whole = day / "day.parquet"
    if whole.exists():
        part = pd.read_parquet(whole, columns=columns)
        # A batch is in the hour in which it begins: 16 digits of microseconds.
        begun = pd.to_datetime(part["_batch"].astype(str).str[:16].astype("int64"), unit="us")
        parts.append(part[~begun.dt.strftime("%H").isin(list(hours))])
    return pd.concat(parts).sort_values("time", kind="stable")


def main(archive: str, robot: str, stream: str) -> None:
    """Print a line for each day."""
    for day in sorted(Path(archive).glob(f"robot={robot}/stream={stream}/date=*")):
        found = samples(day, ["time", "_batch", "speed"])
        print(f"{day.name.partition('=')[2]} {len(found)} {found['speed'].mean():.6f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
