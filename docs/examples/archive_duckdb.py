"""The mean speed of each day from a copy of the archive, with DuckDB.

aws s3 sync s3://BUCKET/archive/robot=car7 archive/robot=car7
python docs/examples/archive_duckdb.py archive car7 vesc
"""

import sys

import duckdb

# An hour that has a file of its own counts from there, not from its day's file. A batch is in the hour in
# which it begins: 16 digits of microseconds.
SAMPLES = """
CREATE MACRO samples(files) AS TABLE
SELECT * EXCLUDE (filename, _own)
FROM (
    SELECT *,
        replace(filename, 'day.parquet', strftime(make_timestamp(CAST(left(_batch, 16) AS BIGINT)), '%H')
            || '.parquet') AS _own
    FROM read_parquet(files, hive_partitioning = true, union_by_name = true, filename = true)
)
WHERE filename = _own OR _own NOT IN (SELECT file FROM glob(files))
"""


def main(archive: str, robot: str, stream: str) -> None:
    """Print a line for each day."""
    database = duckdb.connect()
    database.execute(SAMPLES)
    found = database.execute(
        "SELECT CAST(date AS VARCHAR), count(*), avg(speed) FROM samples(?) GROUP BY date ORDER BY date",
        [f"{archive}/robot={robot}/stream={stream}/*/*.parquet"],
    )
    for date, count, mean in found.fetchall():
        print(f"{date} {count} {mean:.6f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
