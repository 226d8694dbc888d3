"""Measured data: records and how files become records, frequency responses with their ellipses, findings.

`record` and `record_files` read logs, with `table` and its readers below them; `frf_records` and
`frequency_uncertainty` hold measured responses; `nonparametric`, `repeats` and `distortion` look at records
without a model; `finding` is how a check says what it found. Nothing here fits a model.
"""
