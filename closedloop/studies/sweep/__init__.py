"""Sweeps: a scenario with some keys changed, thousands of times, into one table; a sweep can be killed and resumed.

    closedloop sweep wam_slide --over law.force=5:15:101 --out force.parquet
    closedloop sweep plot force.parquet

The table is made of parts, and a part of rows. A part is written atomically, into a folder beside the table; a sweep
that was killed keeps the parts that exist, and runs the others. The content of a part depends on its number and on the
sweep's identity alone, so threads and workers of a cluster give the same table.
"""
