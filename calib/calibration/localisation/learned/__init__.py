"""What was learned of contacts: the contact layer, the law of their force, and the loads of kept presses."""
