"""Copy archives to a bucket and back."""
