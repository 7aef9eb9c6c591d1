"""What a pipeline found, as tables and as an HTML page."""
