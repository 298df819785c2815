"""``report.html``: a fit on one page that needs nothing else: ``python -m gshell_mi.report OUT``."""

from .report import ReportConfig, write_report

__all__ = ["ReportConfig", "write_report"]
