"""Learning compared: CRPN and ACRPN against their peers, from runs to tables and figures.

``python -m benchmarks.learning`` trains and appends to the CSV files of ``results/``;
``python -m benchmarks.learning.report`` makes tables and figures from them alone.
"""
