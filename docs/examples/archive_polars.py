"""The mean speed of each day from a copy of the archive, with Polars.

aws s3 sync s3://BUCKET/archive/robot=car7 archive/robot=car7
python docs/examples/archive_polars.py archive car7 vesc
"""

import sys
from pathlib import Path

import polars as pl


def samples(archive: str, robot: str, stream: str) -> pl.LazyFrame:
    """The samples and their day. An hour that has a file of its own counts from there, not from its day."""
    files = sorted(Path(archive).glob(f"robot={robot}/stream={stream}/date=*/*.parquet"))
    # Files have the fields that their hours had.
    found = pl.concat(
        [
            pl.scan_parquet(file).with_columns(
                date=pl.lit(file.parent.name.partition("=")[2]), is_day=file.stem == "day"
            )
            for file in files
        ],
        how="diagonal_relaxed",
    )
    own = [(file.parent.name.partition("=")[2], int(file.stem)) for file in files if file.stem != "day"]
    hours = pl.LazyFrame(own, schema={"date": pl.String, "hour": pl.Int8}, orient="row")
    # A batch is in the hour in which it begins: 16 digits of microseconds.
    begun = pl.col("_batch").cast(pl.String).str.head(16).cast(pl.Int64).cast(pl.Datetime("us"))
    of_days = (
        found.filter("is_day").with_columns(hour=begun.dt.hour()).join(hours, on=["date", "hour"], how="anti")
    )
    return pl.concat([found.filter(~pl.col("is_day")), of_days.drop("hour")])


def main(archive: str, robot: str, stream: str) -> None:
    """Print a line for each day."""
    of_day = samples(archive, robot, stream).group_by("date").agg(pl.len(), pl.col("speed").mean())
    for date, count, mean in of_day.sort("date").collect().iter_rows():
        print(f"{date} {count} {mean:.6f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
