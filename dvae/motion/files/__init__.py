"""Motion files: a reader for each format, all to one `Recording`, and writers of those that other programs open."""
