"""Association: gate, cost, assignment."""
