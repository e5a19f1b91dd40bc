"""Pictures of runs, studies and drives; Matplotlib is imported when one is drawn."""
