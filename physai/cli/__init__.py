"""What all commands share: how they start and end, and the report on a sweep."""

from physai.cli.command import guard, main, overrides, printable

__all__ = ["guard", "main", "overrides", "printable"]
