"""Networks and equations: pure functions of weights and arrays; they depend on no agent, task or file."""
