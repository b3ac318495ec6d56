"""Results of about eighty configs, kept to tell whether a change of the code changes a result.

`cases` lists the configs, `package` is the one place that calls rootsopt, `compare` says how far
two results are apart, and `reference.json` holds what the package gave when it was last written.
"""
