"""Scripts for the tables and pictures of the results: `python -m benchmarks.studies.NAME`, from the project's folder.

The arguments of each module's `main` are its command line. They include options for tests on little data.
"""
