"""What makes the tables and pictures of the pages: `python -m benchmarks.studies.NAME`, from the project's folder.

Each is a module whose `main` has the command line's arguments, and options by which a test runs it on little.
"""
