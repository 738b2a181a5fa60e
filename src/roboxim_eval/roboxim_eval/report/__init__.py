"""Reports: self-contained pages that open offline, for evaluations, experiments, benchmarks and comparisons of models.

One design: `page` renders the templates, `charts` draws, `parts` has what pages share. `evaluation`, `experiment`,
`benchmark` and `models` say what each page shows.
"""

from roboxim_eval.report.evaluation import PolicyRun, Report, summary, verdict_line, write_report

__all__ = ["PolicyRun", "Report", "summary", "verdict_line", "write_report"]
