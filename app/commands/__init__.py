"""The `airmatrix` commands that are more than a line; `app.cli` puts them together."""
