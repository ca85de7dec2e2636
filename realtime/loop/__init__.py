"""The compiled loop on the wall clock: mailboxes, clocks, scheduling and its latency."""
