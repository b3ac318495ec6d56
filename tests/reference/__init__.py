"""Stored results of about eighty configs, which show whether a change of code changes results.

`cases` lists the configs, and `package` is the one place that calls rootsopt. `compare` says how
far two results are apart. `reference.json` holds the results as they were last stored."""
