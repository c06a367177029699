"""Tests; a package, because some packages of third parties install one of this name."""
