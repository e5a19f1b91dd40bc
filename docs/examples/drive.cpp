// Answers what a robot senses with the commands of an exported policy: drive policy.pt [SHA-256 of the file]
// A line of input holds all that the policy takes, in its order and with spaces between: the joints' positions (rad),
// their velocities (rad/s), the goal. Its answer is a line with the command. The line "start" begins an episode and has
// no answer: a policy with memory forgets. Any other line, and any doubt about the file, ends the program with one line
// on standard error and exit code 2.

#include <torch/jit.h>
#include <torch/script.h>

#include <algorithm>
#include <array>
#include <bit>
#include <charconv>
#include <cmath>
#include <fstream>
#include <iomanip>
#include <iostream>
#include <sstream>

using Error = std::runtime_error;
using Tensors = std::vector<torch::Tensor>;  // float32, [1, ...] each

std::string sha256(std::string message) {  // in hexadecimal, as FIPS 180-4 defines it
    using std::rotr;
    std::array<uint32_t, 8> hash = {};  // begins with the fractions of the square roots of the first primes
    std::array<uint32_t, 64> k = {};    // the fractions of their cube roots
    for (int prime = 2, n = 0; n < 64; ++prime) {
        int divisor = 2;
        while (prime % divisor != 0) ++divisor;
        if (divisor < prime) continue;
        if (n < 8) hash[n] = static_cast<uint32_t>(std::fmod(std::sqrt(prime), 1) * 0x1p32);
        k[n++] = static_cast<uint32_t>(std::fmod(std::cbrt(prime), 1) * 0x1p32);
    }
    const uint64_t bits = message.size() * 8;
    message += '\x80';
    message.resize((message.size() + 8 + 63) / 64 * 64 - 8);
    for (int shift = 56; shift >= 0; shift -= 8) message += static_cast<char>(bits >> shift);
    for (size_t block = 0; block < message.size(); block += 64) {
        std::array<uint32_t, 64> w = {};
        for (int i = 0; i < 64; ++i) w[i / 4] = w[i / 4] << 8 | static_cast<uint8_t>(message[block + i]);
        for (int i = 16; i < 64; ++i) {
            const uint32_t p = w[i - 15], q = w[i - 2];
            w[i] = w[i - 16] + (rotr(p, 7) ^ rotr(p, 18) ^ p >> 3) + w[i - 7] + (rotr(q, 17) ^ rotr(q, 19) ^ q >> 10);
        }
        auto [a, b, c, d, e, f, g, h] = hash;
        for (int i = 0; i < 64; ++i) {
            const uint32_t t = h + (rotr(e, 6) ^ rotr(e, 11) ^ rotr(e, 25)) + ((e & f) ^ (~e & g)) + k[i] + w[i];
            const uint32_t u = (rotr(a, 2) ^ rotr(a, 13) ^ rotr(a, 22)) + ((a & b) ^ (a & c) ^ (b & c));
            h = g, g = f, f = e, e = d + t, d = c, c = b, b = a, a = t + u;
        }
        hash = {hash[0] + a, hash[1] + b, hash[2] + c, hash[3] + d, hash[4] + e, hash[5] + f, hash[6] + g, hash[7] + h};
    }
    std::ostringstream text;
    for (const uint32_t word : hash) text << std::hex << std::setfill('0') << std::setw(8) << word;
    return text.str();
}

struct Policy {
    torch::jit::Module module;
    c10::Dict<std::string, torch::Tensor> golden;  // what it took and gave when it was exported: by name, [pairs, ...]
    std::vector<std::string> inputs, outputs;      // their names, in order

    torch::Tensor pair(const std::string& name, int64_t i) const { return golden.at(name).narrow(0, i, 1); }

    Tensors operator()(const Tensors& given) {
        const c10::IValue answer = module.forward({given.begin(), given.end()});
        const auto parts = answer.isTuple() ? answer.toTuple()->elements().vec() : std::vector<c10::IValue>{answer};
        Tensors found;
        for (size_t i = 0; i < outputs.size(); ++i) {
            found.push_back(parts.at(i).toTensor());
            if (found[i].sizes() != pair(outputs[i], 0).sizes() || !found[i].isfinite().all().item<bool>())
                throw Error("the policy gives a " + outputs[i] + " that is not finite, or of another shape");
        }
        return found;
    }
};

Policy load(const std::string& path, std::string hash) {
    std::stringstream content;
    if (!(content << std::ifstream(path, std::ios::binary).rdbuf())) throw Error("the file is missing or empty");
    if (hash.empty() && !(std::ifstream(path + ".sha256") >> hash)) throw Error("there is no .sha256 beside it");
    if (hash != sha256(content.str())) throw Error("its SHA-256 is not the expected one");
    if (!content.str().starts_with("PK")) throw Error("not a TorchScript file");
    torch::jit::ExtraFilesMap extra = {{"metadata.json", ""}};
    auto module = torch::jit::freeze(torch::jit::load(content, torch::kCPU, extra));
    const std::string& metadata = extra["metadata.json"];
    if (metadata.find("\"format_version\": 4,") == std::string::npos) throw Error("not a policy of format 4");
    // Of the metadata's JSON, the golden pairs are lists of numbers by name, which TorchScript writes in the same way.
    const size_t start = metadata.find('{', metadata.find("\"golden\":")), end = metadata.find('}', start) + 1;
    const auto reader = torch::jit::compile("def golden():\n    pairs = " + metadata.substr(start, end - start) +
                                            "\n    return {key: torch.tensor(pairs[key]) for key in pairs.keys()}\n");
    Policy policy = {module, reader->run_method("golden").to<c10::Dict<std::string, torch::Tensor>>(), {}, {}};
    const auto& arguments = module.get_method("forward").function().getSchema().arguments();
    for (size_t i = 1; i < arguments.size(); ++i) policy.inputs.push_back(arguments[i].name());  // after self
    for (const auto& column : policy.golden)
        if (std::ranges::count(policy.inputs, column.key()) == 0 && column.key() != "error")
            policy.outputs.push_back(column.key());

    for (int64_t i = 0; i < policy.golden.at(policy.inputs.at(0)).size(0); ++i) {
        Tensors given;
        for (const auto& name : policy.inputs) given.push_back(policy.pair(name, i));
        const Tensors found = policy(given);
        for (size_t k = 0; k < found.size(); ++k)
            if ((found[k] - policy.pair(policy.outputs[k], i)).abs().max().item<float>() > 1e-4F)
                throw Error("it does not give the " + policy.outputs[k] + " that it gave when it was exported");
    }
    return policy;
}

bool read_number(std::istream& words, float& number) {
    std::string word;
    words >> word;
    double value = NAN;
    const auto [end, failure] = std::from_chars(word.data(), word.data() + word.size(), value);
    number = static_cast<float>(value);
    return failure == std::errc() && end == word.data() + word.size() && std::isfinite(number);
}

int main(int argc, char** argv) {
    std::string where = "usage: drive policy.pt [SHA-256]";
    try {
        if (argc != 2 && argc != 3) throw Error("the policy file is missing");
        where = argv[1];
        Policy policy = load(where, argc == 3 ? argv[2] : "");
        Tensors given;
        for (const auto& name : policy.inputs) given.push_back(torch::zeros_like(policy.pair(name, 0)));
        const bool remembers = policy.inputs.back() == "memory";
        std::string line;
        for (size_t count = 1; std::getline(std::cin, line); ++count) {
            where = "line " + std::to_string(count);
            if (line == "start" && remembers) given.back() = torch::zeros_like(given.back());
            if (line == "start") continue;
            std::istringstream words(line);
            for (size_t i = 0; i < given.size() - remembers; ++i)
                for (int64_t k = 0, size = given[i].numel(); k < size; ++k)
                    if (!read_number(words, given[i].data_ptr<float>()[k]))
                        throw Error(policy.inputs[i] + " needs " + std::to_string(size) + " finite numbers");
            if (!(words >> std::ws).eof() || std::cin.eof()) throw Error("it has too many numbers, or no line break");
            const Tensors found = policy(given);
            if (remembers) given.back() = found.at(1);
            for (int64_t k = 0, size = found.at(0).numel(); k < size; ++k)
                std::cout << std::setprecision(9) << found[0].flatten()[k].item<float>() << (k + 1 < size ? ' ' : '\n');
            std::cout << std::flush;
        }
    } catch (const std::exception& error) {
        const std::string what = error.what();
        std::cerr << "error: " << where << ": " << what.substr(0, what.find('\n')) << '\n';
        return 2;
    }
}
