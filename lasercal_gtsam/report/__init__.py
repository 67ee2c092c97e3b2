"""The uncertainty report: a calibration as one plain dictionary, and as one page made of it.

- `document`: `make_document`, everything that is shown;
- `file`: `report`, which writes the page and the dictionary;
- `html`: the page.
"""
