"""Pictures of a run: one module per family, each a pure function from typed records to a description

Nothing here reads files, keeps global state or knows about stages; `workflow.report` chooses what is drawn.
"""
