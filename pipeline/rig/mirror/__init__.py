"""The mirror controller: bytes of its two modes, transactions with it, paths and logs, and its driver."""
