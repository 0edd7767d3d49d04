"""Parts of the page that `export_avatar` writes."""

import re

LARGEST = 8_000_000
"""Bytes of a page."""


def section(page, name):
    """The text of the data or the worker in it."""
    (text,) = re.findall(f'<script id="{name}" type="text/plain">(.*?)</script>', page, re.DOTALL)
    return text
