"""The package that joins the rooms: configuration, run directories, stages, command line, figures, report."""
