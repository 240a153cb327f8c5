"""Networks and equations: pure functions of weights and arrays, which know no agent, task or file."""
