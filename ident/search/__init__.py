"""DIRECT over poles, order selection, and what the search saw on its way."""
