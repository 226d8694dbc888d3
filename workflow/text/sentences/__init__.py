"""Sentences about values of `ident` and `control_design`, a typed function each; they end without full stop.

They stand below the tasks, which put some of them into results; sentences about results of tasks stand in
`workflow.describe`.
"""
