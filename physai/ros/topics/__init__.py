"""What nodes say and hear: qualities of service, commands, joint states, goals, emergency stops, diagnostics."""
