"""Study figures, one module for each."""
