"""``report.html``: a diagnosis for somebody who was not there, on one page without network."""

from lerobot_vtrefine.diagnose.report.page import render_report

__all__ = ["render_report"]
