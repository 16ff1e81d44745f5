import jade.core.AID;
import jade.core.Agent;
import jade.core.ProfileImpl;
import jade.core.Runtime;
import jade.core.behaviours.OneShotBehaviour;
import jade.domain.DFService;
import jade.domain.FIPAAgentManagement.DFAgentDescription;
import jade.domain.FIPAAgentManagement.Property;
import jade.domain.FIPAAgentManagement.ServiceDescription;
import jade.domain.FIPAException;
import jade.domain.FIPANames.ContentLanguage;
import jade.domain.FIPANames.InteractionProtocol;
import jade.lang.acl.ACLMessage;
import jade.lang.acl.MessageTemplate;
import jade.util.ExtendedProperties;
import jade.wrapper.ContainerController;
import java.io.IOException;
import java.net.ServerSocket;
import java.util.ArrayList;
import java.util.HashMap;
import java.util.Iterator;
import java.util.List;
import java.util.Map;
import java.util.UUID;
import java.util.logging.Level;
import java.util.logging.Logger;
import java.util.stream.Collectors;

/** The operator as an agent of JADE: it asks for a stack of two items on crex, with letters over HTTP only. */
public class StackOperator extends Agent {
    private static final long TIMEOUT = 60_000;
    private static final String CLIENT = "crex";

    private final String name;
    private final String platform;
    private final String address;
    private final List<String> stack = new ArrayList<>();

    StackOperator(String part) {
        name = field(part, "name");
        String gateway = part.substring(part.indexOf("\"platform\":"));
        platform = field(gateway, "name");
        address = field(gateway, "address");
    }

    /** Starts a platform of JADE with the operator, until standard input ends. The argument is the part as JSON. */
    public static void main(String[] arguments) throws Exception {
        StackOperator operator = new StackOperator(arguments[0]);
        Logger.getLogger("").setLevel(Level.WARNING);
        ExtendedProperties options = new ExtendedProperties();
        options.setProperty("platform-id", "jade");
        options.setProperty("local-host", "127.0.0.1");
        options.setProperty("local-port", freePort());
        String own = "http://127.0.0.1:" + freePort() + "/acc";
        options.setProperty("mtps", "jade.mtp.http.MessageTransportProtocol(" + own + ")");
        options.setProperty("jade_core_messaging_MessageManager_enablemultipledelivery", "false");
        ContainerController container = Runtime.instance().createMainContainer(new ProfileImpl(options));
        container.acceptNewAgent(operator.name, operator).start();
        while (System.in.read() >= 0) {}
        // The platform has nothing to store.
        java.lang.Runtime.getRuntime().halt(0);
    }

    @Override
    protected void setup() {
        addBehaviour(new OneShotBehaviour() {
            @Override
            public void action() {
                claim("ready");
                String reason = "null";
                try {
                    work();
                } catch (Exception failed) {
                    reason = quoted(String.valueOf(failed.getMessage()));
                }
                claim("finished", "stack", stack.stream().map(it -> quoted(it)).toList(), "reason", reason);
            }
        });
    }

    // ANCHOR: work
    private void work() throws FIPAException {
        List<DFAgentDescription> robots = find("fetch", 2);
        List<DFAgentDescription> items = find("payload", 2);
        AID guide = find("guide", 1).get(0).getName();
        // The robot that gets the stack docks first: the other one holds its item until it comes.
        for (String item : allocate(robots, items)) {
            String with = stack.isEmpty() ? CLIENT + "/top" : stack.get(0) + "/b";
            ACLMessage dock = message(ACLMessage.REQUEST, InteractionProtocol.FIPA_REQUEST, guide);
            dock.setOntology("fipa-robot-actions");
            dock.setLanguage(ContentLanguage.FIPA_SL);
            dock.setContent("((action (agent-identifier :name " + guide.getName() + ") (dock :item " + item
                    + " :client " + CLIENT + " :with \"" + with + "\")))");
            send(dock);
            receive(dock, ACLMessage.INFORM);
            stack.add(item);
        }
        ACLMessage look = message(ACLMessage.REQUEST, InteractionProtocol.FIPA_REQUEST, there("crex_stack"));
        look.setContent("look");
        send(look);
        receive(look, ACLMessage.INFORM);
    }
    // ANCHOR_END: work

    private AID there(String agent) {
        // ISGUID: the name is used as it is, without the name of this platform.
        AID id = new AID(agent, AID.ISGUID);
        id.addAddresses(address);
        return id;
    }

    /** Searches at the facilitator of the gateway until this number of agents has a service. */
    private List<DFAgentDescription> find(String type, int number) throws FIPAException {
        ServiceDescription service = new ServiceDescription();
        service.setType(type);
        DFAgentDescription template = new DFAgentDescription();
        template.addServices(service);
        while (true) {
            DFAgentDescription[] found = DFService.search(this, there("df@" + platform), template);
            if (found.length >= number) {
                List<DFAgentDescription> all = List.of(found);
                List<String> names = all.stream().map(it -> quoted(it.getName().getName())).toList();
                claim("found", "service", quoted(type), "agents", names);
                return all;
            }
            doWait(100);
        }
    }

    /** Has each item fetched by one robot, so that the sum of the costs is lowest. Returns the order of docking. */
    private List<String> allocate(List<DFAgentDescription> robots, List<DFAgentDescription> items)
            throws FIPAException {
        AID[] all = robots.stream().map(DFAgentDescription::getName).toArray(AID[]::new);
        List<ACLMessage> calls = new ArrayList<>();
        List<Map<String, ACLMessage>> bids = new ArrayList<>();
        for (DFAgentDescription item : items) {
            ACLMessage call = message(ACLMessage.CFP, InteractionProtocol.FIPA_CONTRACT_NET, all);
            call.setContent("{\"item\":" + quoted(item.getName().getName()) + ",\"pose\":" + pose(item) + "}");
            send(call);
            Map<String, ACLMessage> proposals = new HashMap<>();
            for (AID robot : all) {
                ACLMessage proposal = receive(call, ACLMessage.PROPOSE);
                proposals.put(proposal.getSender().getName(), proposal);
            }
            calls.add(call);
            bids.add(proposals);
        }
        String other = all[0].getName().equals(CLIENT) ? all[1].getName() : all[0].getName();
        double straight = cost(bids.get(0).get(CLIENT)) + cost(bids.get(1).get(other));
        double crossed = cost(bids.get(1).get(CLIENT)) + cost(bids.get(0).get(other));
        int first = straight <= crossed ? 0 : 1;
        award(items.get(first).getName(), bids.get(first), CLIENT);
        award(items.get(1 - first).getName(), bids.get(1 - first), other);
        // Both robots work at the same time.
        for (ACLMessage call : calls) {
            receive(call, ACLMessage.INFORM);
        }
        return List.of(items.get(first).getName().getName(), items.get(1 - first).getName().getName());
    }

    private void award(AID item, Map<String, ACLMessage> proposals, String robot) {
        claim("award", "item", quoted(item.getName()), "robot", quoted(robot), "bids", proposals.entrySet().stream()
                .map(it -> quoted(it.getKey()) + ":" + cost(it.getValue())).collect(Collectors.joining(",", "{", "}")));
        for (ACLMessage proposal : proposals.values()) {
            boolean wins = proposal.getSender().getName().equals(robot);
            ACLMessage decision = proposal.createReply();
            decision.setPerformative(wins ? ACLMessage.ACCEPT_PROPOSAL : ACLMessage.REJECT_PROPOSAL);
            send(decision);
        }
    }

    private ACLMessage message(int performative, String protocol, AID... receivers) {
        ACLMessage message = new ACLMessage(performative);
        message.setProtocol(protocol);
        message.setConversationId(UUID.randomUUID().toString());
        message.setReplyWith(UUID.randomUUID().toString());
        for (AID receiver : receivers) {
            message.addReceiver(receiver);
        }
        return message;
    }

    /** Waits for an answer with this performative. Each other one but `agree` is a failure. */
    private ACLMessage receive(ACLMessage asked, int performative) throws FIPAException {
        MessageTemplate of = MessageTemplate.MatchConversationId(asked.getConversationId());
        while (true) {
            ACLMessage answer = blockingReceive(of, TIMEOUT);
            if (answer == null) {
                throw new FIPAException("no answer to the " + ACLMessage.getPerformative(asked.getPerformative()));
            }
            String shown = ACLMessage.getPerformative(answer.getPerformative()) + " of " + answer.getSender().getName()
                    + ": " + answer.getContent();
            System.err.println(quoted(shown));
            if (answer.getPerformative() == performative) {
                return answer;
            }
            if (answer.getPerformative() != ACLMessage.AGREE) {
                throw new FIPAException(shown);
            }
        }
    }

    private static double cost(ACLMessage proposal) {
        return Double.parseDouble(proposal.getContent());
    }

    /** Returns the pose in the description of an item, which is JSON. */
    private static String pose(DFAgentDescription item) throws FIPAException {
        Iterator<?> services = item.getAllServices();
        while (services.hasNext()) {
            Iterator<?> properties = ((ServiceDescription) services.next()).getAllProperties();
            while (properties.hasNext()) {
                Property property = (Property) properties.next();
                if (property.getName().equals("pose")) {
                    return (String) property.getValue();
                }
            }
        }
        throw new FIPAException("an item has no pose");
    }

    /** Reports to the launcher: a line of JSON. The facts are names and JSON values. */
    private void claim(String kind, Object... facts) {
        StringBuilder line = new StringBuilder("{\"at\":" + System.currentTimeMillis() * 1000);
        line.append(",\"by\":" + quoted(name) + ",\"claim\":" + quoted(kind));
        for (int at = 0; at < facts.length; at += 2) {
            line.append("," + quoted((String) facts[at]) + ":" + facts[at + 1]);
        }
        System.out.println(line + "}");
    }

    private static String quoted(String text) {
        return "\"" + text.replace("\\", "\\\\").replace("\"", "\\\"").replaceAll("\\p{Cntrl}", " ") + "\"";
    }

    /** Returns the first text of the field with this name. */
    private static String field(String json, String name) {
        return json.split("\"" + name + "\":\"")[1].split("\"")[0];
    }

    private static String freePort() throws IOException {
        try (ServerSocket socket = new ServerSocket(0)) {
            return String.valueOf(socket.getLocalPort());
        }
    }
}
