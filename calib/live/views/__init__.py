"""Views of live results: the page, lines of JSON, and rerun."""
