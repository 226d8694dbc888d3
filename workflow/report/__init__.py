"""Pages: numbers into templates. Every sentence and all layout stand in `workflow/templates`."""
