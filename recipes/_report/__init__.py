"""Parts of recipes/report.py and recipes/suite.py: data, pages, figures and learning curves of the results."""
