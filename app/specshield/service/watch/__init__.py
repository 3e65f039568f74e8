"""What an operator sees: lines of the log, gauges, each decision as it is made."""
