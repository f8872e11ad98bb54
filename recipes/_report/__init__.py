"""Parts of recipes/report.py: data, pages, figures and learning curves of the results."""
