"""Ziaei & Wang (2006) redrawn: its seven figures and its numbers beside ours, on one page.

`experiments` computes (no files, no pictures), `figures_*` draw, `table` and `page` put into words, `command`
writes. What the paper says stands in `quotes`, with its place; what we say is computed in the run.
"""
