"""Trade-offs between two or three terms: the front of best compromises, and its gaps."""
