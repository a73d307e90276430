"""What is shown: plots and reports."""
