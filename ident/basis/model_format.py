"""What a file of a model says it is: read before what models need is loaded."""

# `format` of a JSON or MAT file of `ModelFile`.
FORMAT = "flexlink GOBF model"

# `format_version`: the first; files of another one are refused.
FORMAT_VERSION = 1
