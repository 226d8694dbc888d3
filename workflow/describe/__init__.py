"""What there is to say of a result: one typed function a subject, for terminal, page and programs."""
