"""Numbers and templates into words: formats, sentences and tables, for pages and terminals alike."""
