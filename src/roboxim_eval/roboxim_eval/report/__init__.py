"""Reports: self-contained HTML pages for evaluations, experiments, benchmarks and comparisons of models.

One design: `page` renders the templates, `charts` draws, `parts` has shared parts. `evaluation`, `experiment`,
`benchmark` and `models` define the content of each page.
"""

from roboxim_eval.report.evaluation import PolicyRun, Report, summary, verdict_line, write_report

__all__ = ["PolicyRun", "Report", "summary", "verdict_line", "write_report"]
