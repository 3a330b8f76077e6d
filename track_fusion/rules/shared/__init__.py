"""What several rules are made of; the files beside this folder are a rule each."""
