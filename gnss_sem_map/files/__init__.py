"""Reading untrusted files, and writing results without damage to existing files."""
