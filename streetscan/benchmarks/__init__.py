"""The benchmark tables of the papers, theirs beside ours."""
