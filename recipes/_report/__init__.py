"""What recipes/report.py is made of: data, pages, figures and learning curves of the results."""
