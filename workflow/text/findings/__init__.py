"""The sentence of every finding of `ident`: a function for each FindingKind, of the finding's values."""
