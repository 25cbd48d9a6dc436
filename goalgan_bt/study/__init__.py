"""Studies: methods against each other, many seeds, one table and one report.

    python -m goalgan_bt.study point_umaze

Every run is a process of one thread. What is finished stands in `runs.csv` and is not run again;
what was cut off goes on from its checkpoint, where its learner leaves any. The TOML files here are
those that come along.
"""
