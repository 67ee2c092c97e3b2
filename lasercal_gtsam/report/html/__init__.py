"""The report as one self-contained HTML file.

- `page`: `render`, the templates' filters, what is embedded;
- `pictures`, `planes`, `matrices`, `scene`: the figures, as SVG;
- `svg`, `numbers`, `palettes`: what figures are made of;
- ``templates/``, ``report.css``, ``viewer.js``: the page itself.
"""

from lasercal_gtsam.report.html.page import render

__all__ = ["render"]
