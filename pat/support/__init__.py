"""What the rest shares and that knows no vision: jobs, memory, documents, threads."""
